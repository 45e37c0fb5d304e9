"""Patterns of polarizers and color filters on sensors, and levels of the stored values, such as full scale."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from tyro.constructors import PrimitiveConstructorSpec

from polarguide.core.errors import PolarguideError, require

_CELL = np.array([[90, 45], [135, 0]])
_BAYER = np.array([[0, 1], [1, 2]])  # R G / G B, one entry per polarizer cell

Sensor = Literal["IMX250MYR", "IMX250MZR", "IMX253MYR", "IMX253MZR", "IMX264MYR", "IMX264MZR"]
SENSORS: dict[str, bool] = {name: name.endswith("MYR") for name in get_args(Sensor)}
"""Supported Sony sensors by name. The value is True for a color sensor, and False for a monochrome sensor."""
SENSOR_NAMES = (
    "IMX250MYR, IMX253MYR, IMX264MYR (color), IMX250MZR, IMX253MZR, IMX264MZR (monochrome), a camera's model"
)
"""List of the supported sensors for messages."""
SENSOR_SIZES = {name: (4112, 3008) if "253" in name else (2464, 2056) for name in SENSORS}
"""Width and height of each sensor in pixels. The pictures of cameras are slightly smaller, such as 2448 x 2048."""

_CAMERAS: dict[str, Sensor] = {
    "PHX050S-P": "IMX250MZR", "TRI050S-P": "IMX250MZR", "BFS-U3-51S5P": "IMX250MZR", "BFS-PGE-51S5P": "IMX250MZR",
    "acA2440-75umPOL": "IMX250MZR", "DZK 33UX250": "IMX250MZR", "DZK 33GX250": "IMX250MZR", "exo250ZU3": "IMX250MZR",
    "exo250ZGE": "IMX250MZR", "GO-5100MP": "IMX250MZR", "PL-D755MU-POL": "IMX250MZR", "CS505MUP1": "IMX250MZR",
    "PHX050S-Q": "IMX250MYR", "TRI050S-Q": "IMX250MYR", "BFS-U3-51S5PC": "IMX250MYR", "BFS-PGE-51S5PC": "IMX250MYR",
    "acA2440-75ucPOL": "IMX250MYR", "DYK 33UX250": "IMX250MYR", "DYK 33GX250": "IMX250MYR",
    "BFS-PGE-123S6P": "IMX253MZR",
    "PHX050S1-P": "IMX264MZR", "TRI050S1-P": "IMX264MZR", "PHX050S1-Q": "IMX264MYR", "TRI050S1-Q": "IMX264MYR",
}  # fmt: skip
"""Sensor of each camera by the model name of the camera.

Up to three letters for the lens mount or the interface may follow the name.
"""
_MOUNT = re.compile(r"-?[A-Z0-9]{0,3}")


def _normalized(name: str) -> str:
    """Convert a name to upper case, and replace blanks by hyphens."""
    return re.sub(r"[\s_]+", "-", name.strip()).upper()


def sensor_named(name: str) -> str:
    """Return the name of a sensor, given the name of the sensor or the model of a camera.

    The maker may precede the model. Any other name is returned unchanged.
    """
    full = _normalized(name)
    # The longest match: BFS-U3-51S5PC is not BFS-U3-51S5P with the mount C.
    models = sorted(_CAMERAS, key=len, reverse=True)
    for start in (0, *(hyphen.end() for hyphen in re.finditer("-", full))):
        text = full[start:]
        if text in SENSORS:
            return text
        for model in models:
            prefix = _normalized(model)
            if text.startswith(prefix) and _MOUNT.fullmatch(text[len(prefix) :]):
                return _CAMERAS[model]
    return name


def require_sensor(name: str | None) -> None:
    """Refuse a name that is not the name of a supported sensor.

    Raises:
        PolarguideError: the name is unknown.
    """
    if name is None or name in SENSORS:
        return
    raise PolarguideError(
        "--sensor",
        expected=f"a sensor ({', '.join(SENSORS)}) or a camera's model ({', '.join(_CAMERAS)})",
        found=repr(name),
        remedy="Enter the sensor of the camera's data sheet. IMX250MZR has the pattern of all monochrome sensors, "
        "IMX250MYR that for color.",
    )


def any_case(*names: str) -> PrimitiveConstructorSpec[Any]:
    """Create the command-line parser for the name of a sensor or the model of a camera.

    The parser accepts any text. The options check the name later.
    """
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: sensor_named(words[0]),
        is_instance=lambda value: value in names,
        str_from_instance=lambda name: [name],
    )


SensorName = Annotated[Sensor, any_case(*SENSORS)]

Packing = Literal["8", "16", "16be", "10p", "10packed", "10mipi", "12p", "12packed", "12mipi"]
"""Name of the layout of pixel values in ``.raw`` files, see ``sensor.mosaics.PACKINGS``."""


NotNegative = Annotated[int, Meta(ge=0, le=1 << 20)]
Positive = Annotated[int, Meta(ge=1, le=1 << 31)]


@dataclass(frozen=True)
class MosaicOptions:
    """Options of raw mosaics: their files, and their place on the sensor.

    Attributes:
        sensor: Sensor of raw mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera.
        packing: Packing of .raw files (there are several of 10 and of 12 bits; never guessed).
        width: Width of .raw files in pixels; other files must have it as well.
        height: Height of .raw files in pixels.
        offset_x: Column of the sensor at which the region of interest starts.
        offset_y: Row of the sensor at which the region of interest starts.
        black_level: Stored value without light.
    """

    sensor: SensorName | None = None
    packing: Packing | None = None
    width: Positive | None = None
    height: Positive | None = None
    offset_x: NotNegative = 0
    offset_y: NotNegative = 0
    black_level: Annotated[float, Meta(ge=0)] = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.sensor, str):
            object.__setattr__(self, "sensor", sensor_named(self.sensor))


@dataclass(frozen=True, eq=False)
class Pattern:
    """Repeating pattern of polarizers and color filters on a sensor.

    Attributes:
        angles: polarizer angle of each pixel in degrees, [4, 4] for a color sensor, [2, 2] for a monochrome sensor.
        colors: color of each pixel, 0, 1 or 2 for R, G or B, [4, 4]; None for a monochrome sensor.
    """

    angles: NDArray[np.int64]
    colors: NDArray[np.int64] | None

    @property
    def period(self) -> int:
        """Period of the pattern in pixels: 4 for a color sensor, 2 for a monochrome sensor."""
        return int(self.angles.shape[0])

    def shifted(self, x: int, y: int) -> Pattern:
        """Return the pattern of a region that starts at column ``x`` and row ``y`` of this pattern."""
        return Pattern(
            np.roll(self.angles, (-y, -x), axis=(0, 1)),
            None if self.colors is None else np.roll(self.colors, (-y, -x), axis=(0, 1)),
        )

    def cell_corner(self) -> tuple[int, int]:
        """Return the column and the row at which the first whole polarizer cell starts.

        A cell is a square of 2 x 2 pixels with one color and all four angles. Both numbers are zero for a monochrome
        pattern, because any 2 x 2 pixels have all four angles.
        """
        if self.colors is None:
            return 0, 0
        x = 0 if (self.colors[:, 0] == self.colors[:, 1]).all() else 1
        y = 0 if (self.colors[0] == self.colors[1]).all() else 1
        return x, y

    def rows(self) -> list[str]:
        """Format the pattern as text, one string per row: "R90 R45 G90 G45", ..."""
        names = self.angles.astype(str).astype(object)
        if self.colors is not None:
            names = np.array(list("RGB"), dtype=object)[self.colors] + names
        return [" ".join(row) for row in names]


def tiled(pattern: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Repeat a pattern to fill an array of shape [H, W]."""
    repeat = [-(-length // period) for length, period in zip(shape, pattern.shape, strict=True)]
    return np.tile(pattern, repeat)[: shape[0], : shape[1]]


def sensor_pattern(sensor: str) -> Pattern:
    """Return the pattern of a sensor, starting at the top-left pixel of the sensor.

    Raises:
        PolarguideError: the sensor is unknown.
    """
    require_sensor(sensor)
    if not SENSORS[sensor]:
        return Pattern(_CELL.copy(), None)
    return Pattern(np.tile(_CELL, (2, 2)), np.kron(_BAYER, np.ones((2, 2), int)))


FULL_16 = (1 << 16) - 1
"""Largest value of a pixel in 16-bit files."""


@dataclass(frozen=True)
class Levels:
    """Levels that relate the stored values of a capture to linear intensities.

    Attributes:
        bits: number of bits of a sensor value.
        white: stored value of the linear intensity 1.
        saturation: smallest stored value of a saturated sample.
        black: stored value without light.
        gamma: exponent of the stored values: stored = linear ^ gamma.
    """

    bits: int
    white: int
    saturation: int
    black: float
    gamma: float = 1.0

    def is_full(self, container: int) -> bool:
        """Return True if the values use all ``container`` bits of the file, and saturate at the largest value."""
        return self.bits == container and self.saturation == self.white

    def linear(self, values: NDArray[Any], dark: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Convert stored values to linear intensities, float32.

        The result is ``(value - black) / (white - black)`` without the gamma. Noise below the black level gives
        negative intensities.

        Args:
            values: stored values, [..., H, W].
            dark: dark frame in stored values, in the shape of ``values``. It replaces the black level.
        """
        floor = np.float32(self.black) if dark is None else dark
        scaled = ((values.astype(np.float32) - floor) / np.float32(self.white - self.black)).astype(
            np.float32
        )
        if self.gamma == 1.0:
            return scaled
        return np.asarray(np.copysign(np.abs(scaled) ** np.float32(1 / self.gamma), scaled))


def estimate_levels(
    largest: int,
    used: int,
    container: int,
    *,
    bits: int | None,
    black: float,
    saturation: int | None,
    counts: NDArray[np.int64] | None = None,
    stated: int | None = None,
    alone: bool = False,
) -> Levels:
    """Estimate the levels of the stored values of a capture.

    The full scale follows from ``bits``, or from the headers of the files. Otherwise 8-bit files have 8 bits, and the
    number of bits of 16-bit files is estimated. If many samples are clipped at one value, this value gives the number.
    If no value exceeds 4095, it is 12, because the converters of the sensors have 12 bits. In all other cases it is 16.
    If the low bits are never used, the values were shifted to the top of the 16 bits. The full scale is then the
    largest possible value.

    Args:
        largest: largest stored value of the capture.
        used: bitwise or of all stored values.
        container: number of bits of a value in the files, or of a packed pixel.
        bits: number of bits of a sensor value, or None if it is unknown.
        black: stored value without light.
        saturation: stored value at which the sensor saturates; None if it saturates at full scale.
        counts: number of occurrences of each stored value, starting at the value 0.
        stated: full scale in the headers of the files, or None.
        alone: True for a single shot of a series. Clipped values of one shot do not determine the full scale.

    Raises:
        PolarguideError: a stored value exceeds the full scale, or the levels contradict each other.
    """
    stated = stated if bits is None else None
    clipped = None if counts is None or container != 16 else clipping_bits(counts)
    if stated is not None:
        bits = stated.bit_length()
    elif bits is None:
        bits = (None if alone else clipped) or (12 if container == 16 and largest < 4096 else container)
    require(
        largest < 1 << bits,
        "--bits",
        expected=f"values below {1 << bits} for {bits} bits",
        found=str(largest),
        remedy="Enter the number of bits that the files use.",
    )
    white = stated or (1 << bits) - 1
    unused = (used & -used).bit_length() - 1 if used else 0
    if container == 16 and 0 < unused <= 8:
        white = white >> unused << unused
    top = white if clipped is None else min(white, largest)
    top = top if saturation is None else saturation
    require(
        0 <= black < top <= white,
        "--black-level" if not 0 <= black < white else "--saturation",
        expected=f"0 <= black level < saturation <= {white}",
        found=f"black level {black:g}, saturation {top}",
        remedy=f"Enter both in stored values, for {bits} bits.",
    )
    return Levels(bits, white, top, float(black))


def agreed_full_scale(stated: Mapping[Path, int | None]) -> int | None:
    """Return the full scale that all files of a capture state. Return None if no file states it.

    Raises:
        PolarguideError: two files state different values.
    """
    (first, full), *others = stated.items()
    for path, other in others:
        require(
            other == full,
            path,
            expected=f"{_full_text(full)}, like {first.name}",
            found=_full_text(other),
            remedy="Export all files with the same settings, or use --bits.",
        )
    return full


def _full_text(full: int | None) -> str:
    return "a file that states no full scale" if full is None else f"a file that states full scale {full}"


_FEWEST_CLIPPED = 3  # smallest number of samples in a pile
_PILE = 3  # smallest ratio to the counts of smaller values
_BESIDE = 50  # the compared values are smaller by up to a fiftieth


def clipping_bits(counts: NDArray[np.int64]) -> int | None:
    """Return the number of bits of a sensor if clipped samples in 16-bit files show it. Otherwise return None.

    A converter of b bits clips at the value 2^b - 1, so many samples have this value. Many samples with another value
    may show a bright surface.

    Args:
        counts: number of occurrences of each stored value, starting at the value 0.
    """
    occurring = np.flatnonzero(counts)
    top = int(occurring[-1]) if len(occurring) else 0
    bits = top.bit_length()
    if bits < 8 or top != (1 << bits) - 1:
        return None
    beside = int(counts[top - max(1, top // _BESIDE) : top].max(initial=0))
    return bits if counts[top] >= max(_FEWEST_CLIPPED, _PILE * beside + 1) else None


def level_notes(
    levels: Levels,
    counts: NDArray[np.int64] | None,
    container: int,
    bits: int | None,
    stated: int | None = None,
) -> list[str]:
    """Return notes for the user about estimated levels. ``estimate_levels`` describes ``bits`` and ``stated``."""
    notes = []
    if bits is None and stated is not None:
        notes.append(f"{levels.white} is full scale according to the files (change with --bits).")
    if container != 16:
        return notes
    if bits is None and stated is None:
        notes.append(f"Values fill {levels.bits} bits (change with --bits); {levels.white} is full scale.")
    if counts is not None and clipping_bits(counts) is not None and levels.saturation < FULL_16:
        top = int(np.flatnonzero(counts)[-1])
        share = float(counts[levels.saturation :].sum() / counts.sum())
        hint = "(change with --bits and --saturation)"
        if top < levels.white:
            hint = f"(--bits {top.bit_length()} makes it full scale)"
        notes.append(
            f"Values pile up at {top} ({share:.1%} of the samples), which counts as saturated {hint}."
        )
    return notes


def unusable_samples(
    values: NDArray[Any], levels: Levels, dark: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the saturated and the dark samples of a mosaic. The mosaic must start with a whole polarizer cell.

    A sample is saturated if its value is at least ``levels.saturation``. It is dark if it is clipped at 0 below the
    black level. All samples of a 2 x 2 cell of zeros are dark, because nothing was measured. A single zero in a
    brighter cell is valid: a surface at Brewster's angle looks so. Samples near a black level measure that there is
    hardly any light, so they are valid.

    Args:
        values: stored values [H, W]; H and W are even.
        levels: levels of the stored values.
        dark: dark frame in stored values, [H, W], or None.

    Returns:
        The mask of saturated samples, and the mask of dark samples, [H, W] each.
    """
    height, width = values.shape
    zero = values == 0
    cells = zero.reshape(height // 2, 2, width // 2, 2).all(axis=(1, 3))
    black = np.repeat(np.repeat(cells, 2, axis=0), 2, axis=1)
    floor = np.float32(levels.black) if dark is None else dark
    black |= zero & (floor > 0)
    return np.asarray(values >= levels.saturation), black


Kind = Literal["color", "monochrome"]
SIDE = 8
"""Side of the blocks by which color filters are detected, in pixels. A block has 4 x 4 polarizer cells."""
_FEWEST = 100
_DIFFERENT = 0.02
"""Median second difference of cells, relative to their mean, above which the sensor has color filters."""
_EQUAL = 0.006
"""Median second difference of cells, relative to their mean, below which the sensor has no color filters."""
_STRONGER = 1.5
"""Ratio of the differences between cells of different colors to those within a color for a sensor with color filters.

A larger ratio than this one shows color filters.
"""
_ALIKE = 1.35
"""Ratio of the differences as in ``_STRONGER`` below which the sensor has no color filters."""
_SMALL = 0.004
"""Smallest relative difference that noise does not cause."""


def color_filters(blocks: NDArray[Any], saturation: float, floor: float = 0.0) -> Kind | None:
    """Detect from a mosaic whether the polarizer cells of the sensor have color filters.

    The sum over the four angles of a cell does not depend on the polarization. In a Bayer pattern, the two cells along
    one diagonal are green, and the cells along the other diagonal are red and blue. Second differences of the sums
    remove gradients of the picture. With color filters, they are large and have the same sign everywhere. Without color
    filters, they are small, equal along both diagonals, and have random signs.

    Args:
        blocks: stored values [N, 8, 8] of blocks that start with a whole cell.
        saturation: smallest stored value of a saturated sample.
        floor: stored value without light.

    Returns:
        The kind of sensor. It is ``None`` if there are too few bright samples, or if all colors have equal values.
    """
    lit = (blocks < saturation).all(axis=(1, 2))
    cells = blocks[lit].reshape(-1, 4, 2, 4, 2).sum(axis=(2, 4), dtype=np.float64) - 4 * floor
    mean = cells.mean(axis=(1, 2))
    # Read-out noise dominates dark cells.
    bright = mean > 4 * (saturation - floor) / 200
    if bright.sum() < _FEWEST:
        return None
    c = cells[bright] / mean[bright, None, None]
    down = c[:, 0, 0] - 2 * c[:, 1, 1] + c[:, 2, 2]
    up = c[:, 0, 3] - 2 * c[:, 1, 2] + c[:, 2, 1]
    across = c[:, 0, 0] + c[:, 1, 1] - c[:, 0, 1] - c[:, 1, 0]
    signed = max(abs(float(np.median(difference))) / 2 for difference in (down, up, across))
    least, most = sorted(float(np.median(np.abs(difference))) for difference in (down, up))
    spread = max(most, float(np.median(np.abs(across)))) / max(least, _SMALL)
    if signed > _DIFFERENT and spread > _STRONGER:
        return "color"
    return "monochrome" if signed < _EQUAL and spread < _ALIKE else None


def require_kind(sensor: str, blocks: NDArray[Any], levels: Levels) -> None:
    """Refuse mosaics of a color sensor if the user specified a monochrome sensor, and the reverse.

    No later step would detect this mistake.

    Args:
        sensor: name of the sensor, a key of ``SENSORS``.
        blocks: stored values, see ``color_filters``.
        levels: levels of the stored values.

    Raises:
        PolarguideError: the samples contradict the sensor.
    """
    filters = color_filters(blocks, levels.saturation, levels.black)
    if filters is None or (filters == "color") == SENSORS[sensor]:
        return
    other = sensor[:-3] + ("MZR" if SENSORS[sensor] else "MYR")
    raise PolarguideError(
        "--sensor",
        expected=f"mosaics of {sensor}, a {'color' if SENSORS[sensor] else 'monochrome'} sensor",
        found="no sign of color filters" if SENSORS[sensor] else "the Bayer pattern of color filters",
        remedy=f"Use --sensor {other}.",
    )
