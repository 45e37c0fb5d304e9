"""A sensor's pattern of polarizers and color filters, its radiometric levels, and whether samples fit either."""

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

from polarguide.core.errors import PolarguideError

_CELL = np.array([[90, 45], [135, 0]])
_BAYER = np.array([[0, 1], [1, 2]])  # R G / G B, one entry a polarizer cell

Sensor = Literal["IMX250MYR", "IMX250MZR", "IMX253MYR", "IMX253MZR", "IMX264MYR", "IMX264MZR"]
SENSORS: dict[str, bool] = {name: name.endswith("MYR") for name in get_args(Sensor)}
"""Sony sensors by name, and whether they are color sensors. All color ones have one pattern, all others another."""
SENSOR_NAMES = (
    "IMX250MYR, IMX253MYR, IMX264MYR (color), IMX250MZR, IMX253MZR, IMX264MZR (monochrome), a camera's model"
)
"""The same for people."""
SENSOR_SIZES = {name: (4112, 3008) if "253" in name else (2464, 2056) for name in SENSORS}
"""Width and height in pixels; cameras give some less, such as 2448 x 2048."""

_CAMERAS: dict[str, Sensor] = {
    "PHX050S-P": "IMX250MZR", "TRI050S-P": "IMX250MZR", "BFS-U3-51S5P": "IMX250MZR", "BFS-PGE-51S5P": "IMX250MZR",
    "acA2440-75umPOL": "IMX250MZR", "DZK 33UX250": "IMX250MZR", "DZK 33GX250": "IMX250MZR", "exo250ZU3": "IMX250MZR",
    "exo250ZGE": "IMX250MZR", "GO-5100MP": "IMX250MZR", "PL-D755MU-POL": "IMX250MZR", "CS505MUP1": "IMX250MZR",
    "PHX050S-Q": "IMX250MYR", "TRI050S-Q": "IMX250MYR", "BFS-U3-51S5PC": "IMX250MYR", "BFS-PGE-51S5PC": "IMX250MYR",
    "acA2440-75ucPOL": "IMX250MYR", "DYK 33UX250": "IMX250MYR", "DYK 33GX250": "IMX250MYR",
    "BFS-PGE-123S6P": "IMX253MZR",
    "PHX050S1-P": "IMX264MZR", "TRI050S1-P": "IMX264MZR", "PHX050S1-Q": "IMX264MYR", "TRI050S1-Q": "IMX264MYR",
}  # fmt: skip
"""The sensor of a camera by the maker's model name, which a mount or an interface of three letters may follow."""
_MOUNT = re.compile(r"-?[A-Z0-9]{0,3}")


def _spelled(name: str) -> str:
    """A name in capitals, with hyphens for blanks: people and programs write names either way."""
    return re.sub(r"[\s_]+", "-", name.strip()).upper()


def sensor_named(name: str) -> str:
    """The sensor of this name, or in the camera of this model, after its maker or not; another word as it is."""
    whole = _spelled(name)
    # The longest: BFS-U3-51S5PC is another camera than BFS-U3-51S5P with the mount C.
    models = sorted(_CAMERAS, key=len, reverse=True)
    for start in (0, *(found.end() for found in re.finditer("-", whole))):
        spelled = whole[start:]
        if spelled in SENSORS:
            return spelled
        for model in models:
            begin = _spelled(model)
            if spelled.startswith(begin) and _MOUNT.fullmatch(spelled[len(begin) :]):
                return _CAMERAS[model]
    return name


def require_sensor(name: str | None) -> None:
    """Refuse a name that is no sensor's and no known camera's.

    Raises:
        PolarguideError: it is such a one.
    """
    if name is None or name in SENSORS:
        return
    raise PolarguideError(
        "--sensor",
        expected=f"a sensor ({', '.join(SENSORS)}) or a camera's model ({', '.join(_CAMERAS)})",
        found=repr(name),
        remedy="Give the sensor of the camera's data sheet. IMX250MZR has the same pattern as all monochrome ones, "
        "IMX250MYR as all color ones.",
    )


def any_case(*names: str) -> PrimitiveConstructorSpec[Any]:
    """How the command line reads one of some names, sensors among them; the settings check it."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: sensor_named(words[0]),
        is_instance=lambda value: value in names,
        str_from_instance=lambda name: [name],
    )


SensorName = Annotated[Sensor, any_case(*SENSORS)]

Packing = Literal["8", "16", "16be", "10p", "10packed", "10mipi", "12p", "12packed", "12mipi"]
"""How ``.raw`` files hold values, see ``sensor.raw_file.PACKINGS``."""


NotNegative = Annotated[int, Meta(ge=0, le=1 << 20)]
Positive = Annotated[int, Meta(ge=1, le=1 << 31)]


@dataclass(frozen=True)
class MosaicOptions:
    """How raw mosaics lie in their files, and on the sensor.

    Attributes:
        sensor: Sensor of raw mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera.
        packing: Packing of .raw files (there are several of 10 and of 12 bits; never guessed).
        width: Width of .raw files in pixels; others must have it, too.
        height: Height of .raw files in pixels.
        offset_x: Column of the sensor at which the region of interest starts.
        offset_y: Row of the sensor at which it starts.
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
    """The repeating pattern of a sensor or of a region of it.

    Attributes:
        angles: polarizer angle of each pixel in degrees, [4, 4] for a color sensor, [2, 2] for a monochrome one.
        colors: 0, 1, 2 for R, G, B in the same shape, or None for a monochrome sensor.
    """

    angles: NDArray[np.int64]
    colors: NDArray[np.int64] | None

    @property
    def period(self) -> int:
        """Pixels after which the pattern repeats, each way: 4 or 2."""
        return int(self.angles.shape[0])

    def shifted(self, x: int, y: int) -> Pattern:
        """The pattern of a region whose top-left pixel is column ``x``, row ``y`` of this one."""
        return Pattern(
            np.roll(self.angles, (-y, -x), axis=(0, 1)),
            None if self.colors is None else np.roll(self.colors, (-y, -x), axis=(0, 1)),
        )

    def cell_corner(self) -> tuple[int, int]:
        """Columns and rows to cut so that the region starts with a whole polarizer cell of one color.

        A monochrome pattern needs none: any 2x2 pixels hold all four angles.
        """
        if self.colors is None:
            return 0, 0
        x = 0 if (self.colors[:, 0] == self.colors[:, 1]).all() else 1
        y = 0 if (self.colors[0] == self.colors[1]).all() else 1
        return x, y

    def rows(self) -> list[str]:
        """The pattern as text, one string per row: "R90 R45 G90 G45", ..."""
        names = self.angles.astype(str).astype(object)
        if self.colors is not None:
            names = np.array(list("RGB"), dtype=object)[self.colors] + names
        return [" ".join(row) for row in names]


def tiled(pattern: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """A pattern repeated over [H, W]."""
    repeat = [-(-length // period) for length, period in zip(shape, pattern.shape, strict=True)]
    return np.tile(pattern, repeat)[: shape[0], : shape[1]]


def sensor_pattern(sensor: str) -> Pattern:
    """The pattern of a whole sensor, from its top-left pixel.

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
        white: the value that becomes linear 1.
        saturation: the value from which a sample counts as saturated.
        black: the value without light.
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
        """(value - black) / (white - black), made linear, float32; noise below black stays negative.

        Args:
            values: [..., H, W] stored values.
            dark: dark frame in stored values, in the same shape; it takes the place of the black level pixel by pixel.
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

    Without ``bits``: as the files state; else 8 in 8-bit files; in 16-bit files those of the value at which samples
    pile up, else 12 if no value exceeds 4095 (the sensors' converters have 12 bits), else 16. Values whose low bits are
    never used (12 bits shifted to the top of 16) end at the last value that can occur.

    Args:
        largest: the largest stored value of the capture.
        used: bitwise or of all stored values.
        container: bits of the files' values, or of a packed pixel.
        bits: bits of a sensor value, or None.
        black: black level in stored values.
        saturation: stored value at which the sensor saturates, or None for full scale.
        counts: how often each stored value occurs, from 0 on.
        stated: full scale that the files state; None where they do not.
        alone: whether the values are those of a single shot of a series, which do not imply the full scale by piling
            up.

    Raises:
        PolarguideError: a value exceeds the range, or the levels are not in order.
    """
    stated = stated if bits is None else None
    clipped = None if counts is None or container != 16 else clipping_bits(counts)
    if stated is not None:
        bits = stated.bit_length()
    elif bits is None:
        bits = (None if alone else clipped) or (12 if container == 16 and largest < 4096 else container)
    if largest >= 1 << bits:
        raise PolarguideError(
            "--bits",
            expected=f"values below {1 << bits} for {bits} bits",
            found=str(largest),
            remedy="Give the number of bits that the files really use.",
        )
    white = stated or (1 << bits) - 1
    unused = (used & -used).bit_length() - 1 if used else 0
    if container == 16 and 0 < unused <= 8:
        white = white >> unused << unused
    top = white if clipped is None else min(white, largest)
    top = top if saturation is None else saturation
    if not 0 <= black < top <= white:
        raise PolarguideError(
            "--black-level" if not 0 <= black < white else "--saturation",
            expected=f"0 <= black level < saturation <= {white}",
            found=f"black level {black:g}, saturation {top}",
            remedy=f"Give both in stored values, for {bits} bits.",
        )
    return Levels(bits, white, top, float(black))


def agreed_full_scale(stated: Mapping[Path, int | None]) -> int | None:
    """The full scale that all files of a capture state; None where none does.

    Raises:
        PolarguideError: two say otherwise.
    """
    (first, full), *others = stated.items()
    for path, other in others:
        if other != full:
            raise PolarguideError(
                path,
                expected=f"{_full_words(full)}, like {first.name}",
                found=_full_words(other),
                remedy="Export all files with the same settings, or give --bits.",
            )
    return full


def _full_words(full: int | None) -> str:
    return "a file that states no full scale" if full is None else f"a file that states full scale {full}"


_FEWEST_CLIPPED = 3
_PILE = 3
_BESIDE = 50
"""A pile of clipped samples: as many at least; times as many as any value has that is smaller by a fiftieth or less."""


def clipping_bits(counts: NDArray[np.int64]) -> int | None:
    """Bits of a sensor whose clipped samples pile up at the largest value of 16-bit files; None where they do not.

    A converter of b bits clips at 2^b - 1. Other values at which samples pile up may be those of a bright surface.

    Args:
        counts: how often each stored value occurs, from 0 on.
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
    """Notes for the user on levels that the files' type does not imply; ``bits``, ``stated``: as for the estimate."""
    notes = []
    if bits is None and stated is not None:
        notes.append(f"{levels.white} is full scale, as the files state (--bits says otherwise).")
    if container != 16:
        return notes
    if bits is None and stated is None:
        notes.append(f"Values fill {levels.bits} bits (--bits says otherwise); {levels.white} is full scale.")
    if counts is not None and clipping_bits(counts) is not None and levels.saturation < FULL_16:
        top = int(np.flatnonzero(counts)[-1])
        share = float(counts[levels.saturation :].sum() / counts.sum())
        hint = "(--bits and --saturation say otherwise)"
        if top < levels.white:
            hint = f"(--bits {top.bit_length()} makes it full scale)"
        notes.append(f"Values pile up at {top} ({share:.1%} of the samples): taken as saturated {hint}.")
    return notes


def unusable_samples(
    values: NDArray[Any], levels: Levels, dark: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Saturated and dark samples of a mosaic that starts with a whole polarizer cell.

    A sample is saturated from ``levels.saturation`` up. It is dark if it was cut off at 0 below a black level,
    or if none of the four samples of its 2x2 cell exceeds black: then there is no light whose polarization
    could be told. One angle at black beside brighter ones is kept, for that is what a surface at Brewster's
    angle looks like.

    Args:
        values: [H, W] stored values, H and W even.
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
"""Pixels along a block that is looked at: 4 x 4 cells of polarizers."""
_FEWEST = 100
_DIFFERENT = 0.02
"""Median second difference of cells, as a share of their mean, above which there are color filters."""
_EQUAL = 0.006
"""The same, below which there are none."""
_STRONGER = 1.5
"""Ratio of typical differences across filters to those within one, from which on there are filters."""
_ALIKE = 1.35
"""Ratio up to which there are none."""
_SMALL = 0.004
"""Differences that count as none."""


def color_filters(blocks: NDArray[Any], saturation: float, floor: float = 0.0) -> Kind | None:
    """Whether 2x2 cells of polarizers lie behind a Bayer pattern of color filters.

    The sum over a cell's four angles is that of the light, whatever its polarization. In a Bayer pattern two of four
    cells are green, along one diagonal, and those along the other take turns in red and blue: second differences,
    which leave the gradients of the picture out, are then large in the same way everywhere. Without filters they are
    small, alike along both diagonals, and have no sign.

    Args:
        blocks: stored values [N, 8, 8] that begin with a cell.
        saturation: the value from which a sample is saturated. floor: the value without light.

    Returns:
        None where the samples do not tell: too few, too dark, or gray light on balanced filters.
    """
    lit = (blocks < saturation).all(axis=(1, 2))
    cells = blocks[lit].reshape(-1, 4, 2, 4, 2).sum(axis=(2, 4), dtype=np.float64) - 4 * floor
    mean = cells.mean(axis=(1, 2))
    # A cell in the noise of the read-out says nothing.
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
    """Refuse mosaics of the other kind of sensor: nothing later would tell.

    Args:
        sensor: its name, a key of ``SENSORS``. blocks: as for ``color_filters``. levels: levels of the stored values.

    Raises:
        PolarguideError: the samples say that it is another one.
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
