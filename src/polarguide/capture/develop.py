"""Camera files to linear intensities: mosaics of a polarization sensor, and shots through a filter.

Whole captures and single shots are developed here. Callers choose the pictures that are judged together.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import (
    UNIT_GAINS,
    Calibration,
    Gains,
    balancing_gains,
    oriented,
    pair_ratio,
)
from polarguide.capture.checks import measured_gains, pair_moments
from polarguide.capture.filter.camera_files import (
    ExposureData,
    apply_orientation,
    is_camera_raw,
    missing_tags,
    orientation_calibration,
    read_exposure_data,
)
from polarguide.capture.filter.develop import Shift, align_shots, estimate_shifts
from polarguide.capture.filter.shots import Shots, read_stack
from polarguide.capture.formats.pictures import linear_codes, may_use_fewer_bits
from polarguide.capture.layout import require_memory, require_memory_of_each
from polarguide.capture.raw_options import GainOptions, RawMosaicOptions, SampledOptions
from polarguide.capture.sensor.analyzers import (
    AnalyzerCalibration,
    imbalance_notes,
    read_analyzers,
    spread_to_cells,
)
from polarguide.capture.sensor.pattern import (
    FULL_16,
    SENSOR_NAMES,
    SENSOR_SIZES,
    Levels,
    estimate_levels,
    level_notes,
    sensor_pattern,
    tiled,
)
from polarguide.capture.sensor.raw_file import RawFormat, read_mosaic, require_mosaic
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_file
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES

QUARTER_FLIPS = ("90", "270")
"""Values of ``flip`` for mosaics that were turned, in degrees counter-clockwise."""
SMALLEST = 16
"""Pixels of the shorter side of a mosaic."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Bytes that a pixel of the sensor takes at least while a mosaic is developed, by the mode of demosaicing."""


class MosaicFiles:
    """How the mosaics of one sensor are read.

    Attributes:
        pattern: pattern of the top-left pixel that is left after ``cut``.
        crop: columns and rows that ``cut`` takes off.
        corner: column and row of the sensor of that pixel.
        analyzers: calibration of the sensor, or None.
    """

    def __init__(self, options: RawMosaicOptions) -> None:
        """Take sensor, region, packing, dark frame and calibration from the options.

        Raises:
            PolarguideError: the sensor is not named, or the calibration is damaged or of another sensor.
        """
        if options.sensor is None:
            raise PolarguideError(
                "--sensor",
                expected=f"the sensor of raw mosaics: {SENSOR_NAMES}",
                found="none",
                remedy="Name it; color and monochrome sensors have different patterns.",
            )
        self._options = options
        self._sensor = options.sensor
        self._raw = RawFormat(options.width, options.height, options.packing)
        pattern = sensor_pattern(options.sensor).shifted(options.offset_x, options.offset_y)
        self.crop = pattern.cell_corner()
        self.pattern = pattern.shifted(*self.crop)
        self.corner = (options.offset_x + self.crop[0], options.offset_y + self.crop[1])
        self.analyzers = calibration_of(options)

    def read(self, where: Path | str, values: NDArray[Any] | None = None) -> NDArray[Any]:
        """The stored values of a whole mosaic, [H, W], in the sensor's orientation: the camera's mirroring is undone.

        Args:
            where: the file, or what messages call a mosaic in memory.
            values: the mosaic in memory, uint8 or uint16.

        Raises:
            PolarguideError: the file cannot be read, is too small or four pictures side by side, does not fit into
                memory when it is developed, or lies outside of the calibration.
        """
        if values is None:
            self._require_memory(Path(where))
            values = read_mosaic(Path(where), self._raw, least=SMALLEST)
        else:
            require_mosaic(where, values, least=SMALLEST)
        values = self._turned_back(where, values)
        if self.analyzers is not None:
            self.analyzers.require_region(
                (self._options.offset_x, self._options.offset_y), values.shape[::-1], self._options.analyzers
            )
        return values

    def _require_memory(self, path: Path) -> None:
        worked = WORKED[self._options.demosaic]
        raw = self._raw
        remedy = "Give a region of the sensor, or choose --demosaic half or quarter."
        if path.suffix.lower() != ".raw":
            require_memory_of_each([path], worked, "a mosaic", remedy=remedy)
        elif raw.width is not None and raw.height is not None:
            require_memory(
                path, worked * raw.width * raw.height, f"a mosaic of {raw.width}x{raw.height}", remedy=remedy
            )

    def _turned_back(self, where: Path | str, values: NDArray[Any]) -> NDArray[Any]:
        """Return a stored mosaic without the mirroring or the quarter turn that ``flip`` names.

        Raises:
            PolarguideError: it is larger than the sensor, maybe because it was turned.
        """
        flip = self._options.flip
        if flip in QUARTER_FLIPS:
            values = np.rot90(values, -1 if flip == "90" else 1)
        width, height = SENSOR_SIZES[self._sensor]
        left = self._options.offset_x
        top = self._options.offset_y
        rows, columns = values.shape
        if columns > width - left or rows > height - top:
            turned = rows <= width and columns <= height and flip not in QUARTER_FLIPS
            raise PolarguideError(
                where,
                expected=f"a mosaic as the sensor lies, at most {width - left}x{height - top} pixels of {self._sensor}",
                found=f"{columns}x{rows}" + (", one that was turned by a quarter" if turned else ""),
                remedy="Give --flip 90 if it was turned counter-clockwise before it was saved, 270 if clockwise."
                if turned
                else "Check --sensor, --offset-x and --offset-y.",
            )
        values = values[:, ::-1] if flip in ("x", "xy") else values
        return values[::-1] if flip in ("y", "xy") else values

    def depth(self, path: Path, values: NDArray[Any]) -> tuple[int, int | None]:
        """Bits that a pixel takes in a file, and the full scale that it states for its values: None where it states
        none, or where ``bits`` says it.
        """
        stated = self._raw.full_scale(path, values) if self._options.bits is None else None
        return self._raw.container(path, values.dtype), stated

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop to whole cells."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """The dark frame, cut like the mosaics."""
        if self._options.dark_frame is None:
            return None
        dark = self._turned_back(self._options.dark_frame, read_mosaic(self._options.dark_frame, self._raw))
        if dark.shape != shape:
            raise PolarguideError(
                self._options.dark_frame,
                expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
                found=f"{dark.shape[1]}x{dark.shape[0]}",
                remedy="Take it with the same region and settings, the lens covered.",
            )
        return self.cut(dark).astype(np.float32)

    def light_of_blocks(
        self,
        samples: list[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        shape: tuple[int, ...],
    ) -> tuple[float | None, NDArray[np.float64]]:
        """The ratio of the pair sums, None where it is too dark to tell, and colors [3, N] of usable blocks.

        Samples of different angles lie beside one another; weights that interpolate all of them to the center of a
        block of two periods keep gradients of the picture out of the ratio.

        Args:
            samples: ``sample_blocks`` of two periods from each mosaic.
            levels: their levels.
            dark: the dark frame, or None.
            shape: rows and columns of a mosaic, cut.
        """
        values = np.concatenate(samples)
        period = self.pattern.period
        floor = None if dark is None else np.tile(sample_blocks(dark, 2 * period), (len(samples), 1, 1))
        linear = levels.linear(values, floor).astype(np.float64)
        if self.analyzers is not None:
            of_cells = self.analyzers.correction(self.corner, (shape[1], shape[0]))
            cells = linear.reshape(len(samples), -1, period, 2, period, 2)
            planes = [cells[..., row, :, column].copy() for row, column in np.ndindex(2, 2)]
            for matrices, (row, column) in zip(of_cells, np.ndindex(2, 2), strict=True):
                parts = [sample_blocks(m, period) * plane for m, plane in zip(matrices, planes, strict=True)]
                cells[..., row, :, column] = sum(parts)
        rising = (np.arange(period) + 0.5) / period
        tent = np.concatenate([rising, rising[::-1]])
        weighted = linear * tent[:, None] * tent
        places = np.tile(self.pattern.angles, (2, 2))
        # The weights of one angle and color add up to 1 a sample of the period.
        angles = np.stack([weighted[:, places == angle].sum(axis=1) for angle in ANGLES])
        angles *= 4 / period**2
        colors = np.ones((3, len(values)))
        if self.pattern.colors is not None:
            filters = np.tile(self.pattern.colors, (2, 2))
            colors = np.stack([weighted[:, filters == c].sum(axis=1) for c in range(3)]) / [[4], [8], [4]]
        base = levels.black if floor is None else floor
        usable = np.asarray((values < levels.saturation).all(axis=(1, 2)) & (values > base).any(axis=(1, 2)))
        return pair_ratio(angles, usable), colors[:, usable]

    def linear(
        self,
        values: NDArray[Any],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        *masks: NDArray[np.bool_],
        corner: tuple[int, int] | None = None,
    ) -> tuple[NDArray[np.float32], tuple[NDArray[np.bool_], ...]]:
        """Linear samples of a mosaic or of a part of it, corrected by the calibration, and masks of unusable ones.

        Args:
            values: [H, W] stored values, cut. levels: their levels. dark: the dark frame, [H, W], or None.
            masks: [H, W]; a correction mixes the samples of a cell, and so spreads them.
            corner: column and row of the sensor at which a part begins.
        """
        linear = levels.linear(values, dark)
        if self.analyzers is None:
            return linear, masks
        return self.analyzers.apply(linear, offset=corner or self.corner), tuple(map(spread_to_cells, masks))

    def sample_factors(
        self,
        shape: tuple[int, ...],
        gains: Sequence[float],
        white: Sequence[float] = (1, 1, 1),
        scale: float = 1.0,
    ) -> NDArray[np.float32]:
        """The factor of every sample, [H, W]: ``scale``, by the gain of its angle, times that of its color."""
        of_angle = dict(zip(ANGLES, gains, strict=True))
        factors = np.vectorize(lambda angle: scale / of_angle[angle])(self.pattern.angles)
        if self.pattern.colors is not None:
            factors = factors * np.asarray(white)[self.pattern.colors]
        return tiled(factors.astype(np.float32), shape)


def calibration_of(options: RawMosaicOptions) -> AnalyzerCalibration | None:
    """The calibration of the sensor, read once for all mosaics.

    Raises:
        PolarguideError: it is missing, damaged or of another sensor.
    """
    path = options.analyzers
    if path is None:
        return None
    require_file(path, expected="a file of polarguide calibrate", remedy="Check --calibration.")
    state = path.stat()
    calibration = _read_analyzers(path, state.st_mtime_ns, state.st_size)
    calibration.require_sensor(options.sensor, path)
    return calibration


@lru_cache(maxsize=1)
def _read_analyzers(path: Path, *_: int) -> AnalyzerCalibration:
    return read_analyzers(path)


_BLOCKS = 1024


def sample_blocks(values: NDArray[Any], size: int) -> NDArray[Any]:
    """A regular subset of a mosaic's blocks, [N, size, size]."""
    rows = values.shape[0] // size
    columns = values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    row, column = np.divmod(np.arange(0, rows * columns, max(1, rows * columns // _BLOCKS)), max(columns, 1))
    return grid.swapaxes(1, 2)[row, column]


LARGE_IMBALANCE = 0.01
"""Share by which pair sums differ that is worth a note where it is not corrected."""


def pair_gains(
    ratio: float | None, options: GainOptions, notes: Mapping[str, str], *, calibrated: bool = False
) -> tuple[Gains, list[str]]:
    """Return the gains of the four angles, and notes for the user.

    Args:
        ratio: ratio of the pair sums; None where it is too dark to measure.
        options: gains of a calibration take precedence over ``gains``.
        notes: sentence for each outcome, with a place for the ratio's deviation from 1. Outcomes are "dark", "off" (too
            much for gains), "corrected" and "left" (uncorrected, by more than ``LARGE_IMBALANCE``).
        calibrated: whether the intensities were corrected by analyzer vectors, which include gains.
    """
    if calibrated:
        return UNIT_GAINS, imbalance_notes(ratio)
    if options.calibration.gains is not None:
        return options.calibration.gains, []
    gains = balancing_gains(ratio)
    deviation = 0.0 if ratio is None else ratio - 1
    if gains is None:
        outcome = "dark" if ratio is None else "off"
    elif options.gains == "auto":
        outcome = "corrected"
    else:
        outcome = "left" if abs(deviation) > LARGE_IMBALANCE else ""
    used = gains if gains is not None and outcome == "corrected" else UNIT_GAINS
    return used, [notes[outcome].format(deviation)] if outcome in notes else []


def as_displayed(
    linear: NDArray[np.float32], calibration: Calibration, orientation: int
) -> NDArray[np.float32]:
    """Four shots [4, H, W, C] by true angle, turned as EXIF's orientation displays them."""
    turned = np.stack([apply_orientation(picture, orientation) for picture in oriented(linear, calibration)])
    return oriented(turned, orientation_calibration(orientation))


# Logarithm of a ratio of exposures that are the same: files state three digits.
_EQUAL = 1e-3


def light_of_files(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[Path, float], str]:
    """The exposure that each file of some views states (EXIF), for which light is divided by it.

    Args:
        views: the files of each.
        advance: receives the number of views that were read.

    Returns:
        Those of the files that state one; none where files do not state the same tags. And a sentence for the user in
        that case, else "".

    Raises:
        PolarguideError: a file cannot be read.
    """
    taken: dict[Path, ExposureData] = {}
    for number, paths in enumerate(views.values(), 1):
        taken |= {path: read_exposure_data(path) for path in paths}
        if advance is not None:
            advance(number)
    missing = missing_tags(taken)
    stating = {} if missing else taken
    return {path: light for path, data in stating.items() if (light := data.light) is not None}, missing


def stated_exposures(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[str, list[float]], str]:
    """Relative exposures of ``light_of_files``, their geometric mean over all views 1.

    Returns:
        Those of all views; nothing where all state the same, or where files do not state the same tags. And the
        sentence of ``light_of_files``.
    """
    stated, missing = light_of_files(views, advance)
    logs = {path: math.log(light) for path, light in stated.items()}
    if not logs or max(logs.values()) - min(logs.values()) < _EQUAL:
        return {}, missing
    mean = sum(logs.values()) / len(logs)
    return {view: [math.exp(logs[path] - mean) for path in paths] for view, paths in views.items()}, ""


def exposure_notes(stated: Mapping[str, Sequence[float]]) -> list[str]:
    """The exposures that the files state, in a sentence for the user."""
    if not stated:
        return []
    every = [value for of_view in stated.values() for value in of_view]
    stops = math.log2(max(every) / min(every))
    within = sum(math.log(max(mine) / min(mine)) >= _EQUAL for mine in stated.values())
    return [
        f"Exposures differ by up to {stops:.2f} stops by EXIF, in {within} views from shot to shot: taken back "
        "(--gains none leaves them)."
    ]


def exposures_of_view(
    names: Sequence[str], gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_], stated: Sequence[float]
) -> tuple[Gains, str]:
    """The exposures of four shots: as their files state, unless their pair sums surely say otherwise.

    Args:
        names: names of the shots, for messages.
        gray: linear intensities [4, H, W]. usable: [H, W].
        stated: exposures that the files state, or ones.

    Returns:
        Gains by which the shots are divided; and a warning where the pair sums contradict the files, else "".
    """
    logs = np.log(np.asarray(stated, np.float64))
    mean = float(logs.mean())
    measured = measured_gains(pair_moments(gray, usable))
    off = {} if measured is None else measured.deviating(list(logs - mean))
    if measured is None or not off:
        return _as_gains(np.exp(logs)), ""
    differ = float(np.ptp(logs)) >= _EQUAL
    named = ", ".join(
        f"{names[ANGLES.index(angle)]} ({angle} degrees) by {factor - 1:+.0%}"
        for angle, factor in off.items()
    )
    than = "than their EXIF exposures say" if differ else "than the other shots of the view"
    warning = (
        f"exposed otherwise {than}, by the pair sums: {named}. The pair sums are believed. Automatic exposure, edited "
        "pictures, or a filter that was not turned?"
    )
    return _as_gains(np.exp(np.asarray(measured.logs) + mean)), warning


def _as_gains(values: Iterable[float]) -> Gains:
    first, second, third, fourth = map(float, values)
    return first, second, third, fourth


COMPARABLE = "Keep one kind: their brightness cannot be compared."
"""The remedy for several kinds of files in one capture or set."""


def require_one(where: Path, found: Iterable[tuple[str, Path]], expected: str, remedy: str) -> None:
    """Refuse pictures that differ in what they should share, such as their size; the first file of each is named.

    Args:
        where: their folder. found: of each file, what it has, and its path. expected, remedy: for the message.

    Raises:
        PolarguideError: two differ.
    """
    first: dict[str, Path] = {}
    for name, path in found:
        first.setdefault(name, path)
    if len(first) > 1:
        named = " and ".join(f"{name} ({path.name})" for name, path in list(first.items())[:4])
        raise PolarguideError(where, expected=expected, found=named, remedy=remedy)


def levels_of_capture(
    counts: NDArray[np.int64],
    container: int,
    options: SampledOptions,
    *,
    black: float = 0.0,
    stated: int | None = None,
) -> tuple[Levels, list[str]]:
    """Return the levels of the stored values of a capture, and notes for the user.

    Args:
        counts: number of occurrences of each stored value, from 0. container: bits of a value in the files.
        options: ``bits`` and ``saturation``.
        black: black level. stated: full scale that all files state.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    occurring = np.flatnonzero(counts)
    levels = estimate_levels(
        int(occurring[-1]), int(np.bitwise_or.reduce(occurring)), container,
        bits=options.bits, black=black, saturation=options.saturation, counts=counts, stated=stated,
    )  # fmt: skip
    return levels, level_notes(levels, counts, container, options.bits, stated)


def levels_of_shot(
    values: NDArray[Any],
    container: int,
    options: SampledOptions,
    *,
    bits: int | None,
    black: float = 0.0,
    stated: int | None = None,
) -> tuple[Levels, list[str]]:
    """Return the levels of the stored values of a single shot, and notes for the user.

    Values that pile up are saturated, but do not change the full scale: it is the same for all shots of a series.

    Args:
        values: [K, ...] stored values. bits: bits of a sensor value, if they are known.
        container, options, black, stated: as for ``levels_of_capture``.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    largest = int(values.max())
    counts = None
    # Only values that end at a power of two can pile up. Counting takes longer than this test.
    may_pile_up = container == 16 and largest < FULL_16 and largest & (largest + 1) == 0
    if may_pile_up and options.bits is None and options.saturation is None:
        parts = (np.bincount(part.ravel(), minlength=FULL_16 + 1) for part in values)
        counts = sum(parts, np.zeros(1, np.int64))
    levels = estimate_levels(
        largest, int(np.bitwise_or.reduce(values, None)), container,
        bits=bits, black=black, saturation=options.saturation, counts=counts, stated=stated, alone=True,
    )  # fmt: skip
    return levels, level_notes(levels, counts, container, bits, stated)


def levels_of_pictures(
    paths: Sequence[Path], white: tuple[float, float, float], options: SampledOptions
) -> tuple[Levels | None, list[str]]:
    """Return the levels of all pictures of a capture, and notes; None where every file states its full scale.

    Args:
        paths: files of the capture. white: gains of R, G and B, for camera raw files.
        options: as for ``levels_of_capture``.

    Raises:
        PolarguideError: as for ``levels_of_capture``.
    """
    wide = [path for path in paths if not is_camera_raw(path) and may_use_fewer_bits(path)]
    if not wide and options.bits is None and options.saturation is None:
        return None, []
    counts = np.zeros(FULL_16 + 1, np.int64)
    container = 8
    for path in wide or paths:
        values = read_stack([path], white).pictures
        container = 8 * values.dtype.itemsize
        counts += np.bincount(values.ravel(), minlength=len(counts))
    levels, notes = levels_of_capture(counts, container, options)
    return levels, [] if levels.is_full(container) else notes


@dataclass(frozen=True, eq=False)
class LinearShots:
    """Linear intensities of the shots of a view, of which four may be aligned.

    Attributes:
        values: [K, H, W, 3] linear intensities, full scale 1.
        saturated: pixels with a saturated sample, [H, W].
        dark: pixels without light in any shot, [H, W].
        outside: pixels that the camera's motion moved out of a shot, [H, W].
        shifts: shifts of the shots.
        orientation: EXIF orientation of the shots.
        clipped_share, dark_share: shares of such pixels before the alignment.
    """

    values: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    dark: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    shifts: list[Shift]
    orientation: int
    clipped_share: float
    dark_share: float

    @property
    def invalid(self) -> NDArray[np.bool_]:
        """Pixels without a measurement, [H, W]."""
        return self.saturated | self.dark | self.outside

    @classmethod
    def of(cls, shots: Shots, transfer: str, *, align: bool) -> LinearShots:
        """Decode the stored values, and align the shots if ``align``."""
        values = linear_codes(shots.pictures, transfer).astype(np.float32) / np.float32(FULL_CODE)
        shifts = estimate_shifts(values) if align else [Shift(0.0, 0.0, True)] * len(values)
        values, (saturated, dark), outside = align_shots(values, (shots.clipped, shots.dark), shifts)
        return cls(
            values,
            saturated,
            dark,
            outside,
            shifts,
            shots.orientation,
            float(shots.clipped.any(axis=0).mean()),
            float(shots.dark.mean()),
        )

    def evenly_exposed(
        self, names: Sequence[str], stated: Sequence[float], options: GainOptions
    ) -> tuple[NDArray[np.float32], Gains, str]:
        """Divide four shots by their exposures.

        Args:
            names: names of the shots, for messages. stated: exposures that the files state, or ones.
            options: ``gains`` auto without gains of a calibration measures exposures by the pair sums.

        Returns:
            The intensities, the exposures, and the warning of ``exposures_of_view``.
        """
        exposures = _as_gains(stated)
        warning = ""
        if options.gains == "auto" and options.calibration.gains is None:
            exposures, warning = exposures_of_view(names, self.values.mean(axis=3), ~self.invalid, stated)
        return self.values / np.asarray(exposures, np.float32)[:, None, None, None], exposures, warning
