"""Pattern of polarizers and color filters of a sensor, and its radiometric levels."""

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
"""Sony sensors by name; True for color sensors. All color sensors have one pattern, all monochrome sensors another."""
SENSOR_NAMES = (
    "IMX250MYR, IMX253MYR, IMX264MYR (color), IMX250MZR, IMX253MZR, IMX264MZR (monochrome), a camera's model"
)
"""Names of the sensors for the user."""
SENSOR_SIZES = {name: (4112, 3008) if "253" in name else (2464, 2056) for name in SENSORS}
"""Width and height in pixels. Cameras deliver somewhat less, such as 2448 x 2048."""

_CAMERAS: dict[str, Sensor] = {
    "PHX050S-P": "IMX250MZR", "TRI050S-P": "IMX250MZR", "BFS-U3-51S5P": "IMX250MZR", "BFS-PGE-51S5P": "IMX250MZR",
    "acA2440-75umPOL": "IMX250MZR", "DZK 33UX250": "IMX250MZR", "DZK 33GX250": "IMX250MZR", "exo250ZU3": "IMX250MZR",
    "exo250ZGE": "IMX250MZR", "GO-5100MP": "IMX250MZR", "PL-D755MU-POL": "IMX250MZR", "CS505MUP1": "IMX250MZR",
    "PHX050S-Q": "IMX250MYR", "TRI050S-Q": "IMX250MYR", "BFS-U3-51S5PC": "IMX250MYR", "BFS-PGE-51S5PC": "IMX250MYR",
    "acA2440-75ucPOL": "IMX250MYR", "DYK 33UX250": "IMX250MYR", "DYK 33GX250": "IMX250MYR",
    "BFS-PGE-123S6P": "IMX253MZR",
    "PHX050S1-P": "IMX264MZR", "TRI050S1-P": "IMX264MZR", "PHX050S1-Q": "IMX264MYR", "TRI050S1-Q": "IMX264MYR",
}  # fmt: skip
"""Sensors by the maker's model name of a camera. Up to three letters for mount or interface may follow."""
_MOUNT = re.compile(r"-?[A-Z0-9]{0,3}")


def _normalized(name: str) -> str:
    """Convert a name to capitals, with hyphens instead of blanks."""
    return re.sub(r"[\s_]+", "-", name.strip()).upper()


def sensor_named(name: str) -> str:
    """Return the sensor of a sensor's name or a camera's model, with or without its maker; other names unchanged."""
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
    """Refuse a name that is not a sensor's.

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
    """Create the command-line parser of names, including camera models. The settings check the result."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: sensor_named(words[0]),
        is_instance=lambda value: value in names,
        str_from_instance=lambda name: [name],
    )


SensorName = Annotated[Sensor, any_case(*SENSORS)]

Packing = Literal["8", "16", "16be", "10p", "10packed", "10mipi", "12p", "12packed", "12mipi"]
"""Layout of values in ``.raw`` files, see ``sensor.raw_file.PACKINGS``."""


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
    """Repeating pattern of a sensor or of a region of it.

    Attributes:
        angles: polarizer angle of each pixel in degrees, [4, 4] for a color sensor, [2, 2] for a monochrome sensor.
        colors: 0, 1, 2 for R, G, B in the same shape; None for a monochrome sensor.
    """

    angles: NDArray[np.int64]
    colors: NDArray[np.int64] | None

    @property
    def period(self) -> int:
        """Period of the pattern in pixels: 4 or 2."""
        return int(self.angles.shape[0])

    def shifted(self, x: int, y: int) -> Pattern:
        """Return the pattern of a region whose top-left pixel is column ``x``, row ``y`` of this one."""
        return Pattern(
            np.roll(self.angles, (-y, -x), axis=(0, 1)),
            None if self.colors is None else np.roll(self.colors, (-y, -x), axis=(0, 1)),
        )

    def cell_corner(self) -> tuple[int, int]:
        """Return the number of columns and rows before the first whole polarizer cell of one color.

        They are zero for a monochrome pattern, because any 2x2 pixels have all four angles.
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
    """Repeat a pattern over [H, W]."""
    repeat = [-(-length // period) for length, period in zip(shape, pattern.shape, strict=True)]
    return np.tile(pattern, repeat)[: shape[0], : shape[1]]


def sensor_pattern(sensor: str) -> Pattern:
    """Return the pattern of a whole sensor from its top-left pixel.

    Raises:
        PolarguideError: the sensor is unknown.
    """
    require_sensor(sensor)
    if not SENSORS[sensor]:
        return Pattern(_CELL.copy(), None)
    return Pattern(np.tile(_CELL, (2, 2)), np.kron(_BAYER, np.ones((2, 2), int)))


FULL_16 = (1 << 16) - 1
"""Largest value of 16-bit files."""


@dataclass(frozen=True)
class Levels:
    """Radiometric levels of a capture, in stored values.

    Attributes:
        bits: bits of a sensor value.
        white: stored value of linear 1.
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
        """Return True if values fill all ``container`` bits of the file and saturate at full scale."""
        return self.bits == container and self.saturation == self.white

    def linear(self, values: NDArray[Any], dark: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return (value - black) / (white - black), made linear, float32. Noise below black stays negative.

        Args:
            values: stored values, [..., H, W].
            dark: dark frame in stored values, in the same shape, instead of the black level.
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
    """Estimate the full scale of a capture.

    Without ``bits``, the files' full scale applies, or 8 bits for 8-bit files. In 16-bit files the bits are those of
    the value at which samples pile up, else 12 if no value exceeds 4095 (the sensors' converters have 12 bits), else
    16. If low bits are never used (12 bits shifted to the top of 16), full scale is the largest possible value.

    Args:
        largest: largest stored value of the capture.
        used: bitwise or of all stored values.
        container: bits of the files' values, or of a packed pixel.
        bits: bits of a sensor value, or None.
        black: black level in stored values.
        saturation: stored value at which the sensor saturates, or None for full scale.
        counts: histogram of the stored values from 0.
        stated: full scale in the files' headers, or None.
        alone: True for a single shot of a series, in which piled-up values do not imply the full scale.

    Raises:
        PolarguideError: a value exceeds the range, or the levels are not in order.
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
    """Return the full scale that all files of a capture state; None if they state none.

    Raises:
        PolarguideError: two files differ.
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
    """Return the bits of a sensor with a pile of clipped samples at the largest value of 16-bit files, or None.

    A converter of b bits clips at 2^b - 1. A pile at another value may be a bright surface.

    Args:
        counts: histogram of the stored values from 0.
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
    """Return notes for the user on estimated levels; for ``bits`` and ``stated`` see ``estimate_levels``."""
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
    """Return masks of saturated and dark samples of a mosaic that starts with a whole polarizer cell.

    A sample is saturated from ``levels.saturation``. It is dark if it is clipped at 0 below a black level, or if no
    sample of its 2x2 cell exceeds black: then there is no light whose polarization could be measured. A single black
    angle next to brighter ones is valid, because surfaces at Brewster's angle look like this.

    Args:
        values: stored values [H, W], H and W even.
        levels: levels of the capture.
        dark: dark frame in stored values, [H, W].

    Returns:
        Two masks [H, W].
    """
    height, width = values.shape
    floor = np.float32(levels.black) if dark is None else dark
    lit = (values > floor).reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3))
    black = np.repeat(np.repeat(~lit, 2, axis=0), 2, axis=1)
    if levels.black > 0 or dark is not None:
        black |= (values == 0) & (floor > 0)
    return np.asarray(values >= levels.saturation), black


Kind = Literal["color", "monochrome"]
SIDE = 8
"""Side of the compared blocks in pixels: 4 x 4 cells of polarizers."""
_FEWEST = 100
_DIFFERENT = 0.02
"""Median second difference of cells relative to their mean, above which there are color filters."""
_EQUAL = 0.006
"""Median second difference of cells relative to their mean, below which there are no color filters."""
_STRONGER = 1.5
"""Ratio of typical differences across filters to those within one, above which there are color filters."""
_ALIKE = 1.35
"""Ratio of these differences below which there are no color filters."""
_SMALL = 0.004
"""Smallest relative difference above noise."""


def color_filters(blocks: NDArray[Any], saturation: float, floor: float = 0.0) -> Kind | None:
    """Detect whether 2x2 cells of polarizers are behind a Bayer pattern of color filters.

    The sum over a cell's four angles measures light regardless of polarization. In a Bayer pattern two of four cells
    are green, along one diagonal; red and blue alternate along the other. Second differences remove the gradients of
    the picture. With color filters they are large and have the same sign everywhere. Without color filters they are
    small, equal along both diagonals, and have no sign.

    Args:
        blocks: stored values [N, 8, 8] that start with a cell.
        saturation: smallest stored value of a saturated sample.
        floor: stored value without light.

    Returns:
        The kind of sensor; None if samples are too few, too dark, or gray behind balanced filters.
    """
    lit = (blocks < saturation).all(axis=(1, 2))
    cells = blocks[lit].reshape(-1, 4, 2, 4, 2).sum(axis=(2, 4), dtype=np.float64) - 4 * floor
    mean = cells.mean(axis=(1, 2))
    # Dark cells are dominated by read-out noise.
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
    """Refuse mosaics of the other kind of sensor. No later step would detect this mistake.

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
