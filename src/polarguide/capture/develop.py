"""Linear intensities from camera files: mosaics of a polarization sensor, and shots through a filter.

Captures and single shots share these functions. The caller chooses the pictures that are evaluated together.
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
"""Values of ``flip`` for mosaics that were rotated, in degrees counter-clockwise."""
SMALLEST = 16
"""Smallest number of pixels of the shorter side of a mosaic."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Smallest memory in bytes per sensor pixel during the development of a mosaic, by demosaicing mode."""


class MosaicFiles:
    """Reader of the mosaics of one sensor.

    Attributes:
        pattern: pattern of the sensor, starting at the top-left pixel after ``cut``.
        crop: columns and rows that ``cut`` removes.
        corner: column and row of that pixel on the sensor.
        analyzers: calibration of the sensor, or None.
    """

    def __init__(self, options: RawMosaicOptions) -> None:
        """Take sensor, region, packing, dark frame and calibration from the options.

        Raises:
            PolarguideError: the sensor is missing, or the calibration is damaged or belongs to another sensor.
        """
        if options.sensor is None:
            raise PolarguideError(
                "--sensor",
                expected=f"the sensor of raw mosaics: {SENSOR_NAMES}",
                found="none",
                remedy="Name the sensor: color and monochrome sensors have different patterns.",
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
        """Return the stored values [H, W] of a whole mosaic in the orientation of the sensor.

        Args:
            where: path of the file, or a name for messages if the mosaic is in memory.
            values: mosaic in memory, uint8 or uint16.

        Raises:
            PolarguideError: the file is unreadable, too small or a grid of four pictures, the mosaic exceeds the
                memory, or it reaches beyond the calibrated region.
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
        remedy = "Specify a region of the sensor, or choose --demosaic half or quarter."
        if path.suffix.lower() != ".raw":
            require_memory_of_each([path], worked, "a mosaic", remedy=remedy)
        elif raw.width is not None and raw.height is not None:
            require_memory(
                path, worked * raw.width * raw.height, f"a mosaic of {raw.width}x{raw.height}", remedy=remedy
            )

    def _turned_back(self, where: Path | str, values: NDArray[Any]) -> NDArray[Any]:
        """Undo the mirroring or rotation that ``flip`` specifies.

        Raises:
            PolarguideError: the mosaic is larger than the sensor, possibly because it was rotated.
        """
        flip = self._options.flip
        if flip in QUARTER_FLIPS:
            values = np.rot90(values, -1 if flip == "90" else 1)
        width, height = SENSOR_SIZES[self._sensor]
        left = self._options.offset_x
        top = self._options.offset_y
        rows, columns = values.shape
        if columns > width - left or rows > height - top:
            rotated = rows <= width and columns <= height and flip not in QUARTER_FLIPS
            raise PolarguideError(
                where,
                expected=f"a mosaic in the orientation of the sensor, at most {width - left}x{height - top} pixels of "
                f"{self._sensor}",
                found=f"{columns}x{rows}" + (", probably rotated by 90 degrees" if rotated else ""),
                remedy="Use --flip 90 if the mosaic was rotated counter-clockwise, --flip 270 if clockwise."
                if rotated
                else "Check --sensor, --offset-x and --offset-y.",
            )
        values = values[:, ::-1] if flip in ("x", "xy") else values
        return values[::-1] if flip in ("y", "xy") else values

    def depth(self, path: Path, values: NDArray[Any]) -> tuple[int, int | None]:
        """Return the bits per pixel of a file and the full scale that it states.

        It returns None as full scale if the file states none or the user specifies ``bits``.
        """
        stated = self._raw.full_scale(path, values) if self._options.bits is None else None
        return self._raw.container(path, values.dtype), stated

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop a mosaic to whole cells of the pattern."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """Return the dark frame, cropped like the mosaics; None without one."""
        if self._options.dark_frame is None:
            return None
        dark = self._turned_back(self._options.dark_frame, read_mosaic(self._options.dark_frame, self._raw))
        if dark.shape != shape:
            raise PolarguideError(
                self._options.dark_frame,
                expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
                found=f"{dark.shape[1]}x{dark.shape[0]}",
                remedy="Photograph it with the same region and settings, and with the lens covered.",
            )
        return self.cut(dark).astype(np.float32)

    def light_of_blocks(
        self,
        samples: list[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        shape: tuple[int, ...],
    ) -> tuple[float | None, NDArray[np.float64]]:
        """Return the ratio of the pair sums and the colors [3, N] of the usable blocks.

        Samples of different angles lie at different pixels. Tent weights interpolate all of them to the center of a
        block of two periods, so gradients of the picture cancel in the ratio. Dark blocks have the ratio None.

        Args:
            samples: ``sample_blocks`` of two periods from each mosaic.
            levels: levels of the stored values.
            dark: dark frame, or None.
            shape: rows and columns of a mosaic after ``cut``.
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
        # The weights of each angle and color sum to the number of their samples in a period.
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
        """Linearize a mosaic or a part of it, apply the calibration, and dilate masks of unusable samples.

        Args:
            values: stored values [H, W] after ``cut``. levels: levels of the values. dark: dark frame [H, W], or None.
            masks: masks [H, W]; the calibration mixes the samples of a cell, so a mask covers whole cells.
            corner: column and row of the first pixel of a part on the sensor.
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
        """Return the factor of every sample, [H, W]: ``scale * white / gain`` for its color and angle."""
        of_angle = dict(zip(ANGLES, gains, strict=True))
        factors = np.vectorize(lambda angle: scale / of_angle[angle])(self.pattern.angles)
        if self.pattern.colors is not None:
            factors = factors * np.asarray(white)[self.pattern.colors]
        return tiled(factors.astype(np.float32), shape)


def calibration_of(options: RawMosaicOptions) -> AnalyzerCalibration | None:
    """Return the calibration of the sensor, cached for all mosaics; None without one.

    Raises:
        PolarguideError: the file is missing, damaged or belongs to another sensor.
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
    """Return a regular subset of the blocks of a mosaic, [N, size, size]."""
    rows = values.shape[0] // size
    columns = values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    row, column = np.divmod(np.arange(0, rows * columns, max(1, rows * columns // _BLOCKS)), max(columns, 1))
    return grid.swapaxes(1, 2)[row, column]


LARGE_IMBALANCE = 0.01
"""Relative difference of uncorrected pair sums above which the user gets a note."""


def pair_gains(
    ratio: float | None, options: GainOptions, notes: Mapping[str, str], *, calibrated: bool = False
) -> tuple[Gains, list[str]]:
    """Return the gains of the four angles and notes for the user.

    Args:
        ratio: ratio of the pair sums; None if the pictures are too dark.
        options: gains of a calibration take precedence over ``gains``.
        notes: templates with a placeholder for the ratio minus 1, by outcome: "dark", "off" (too large for gains),
            "corrected" and "left" (not corrected, above ``LARGE_IMBALANCE``).
        calibrated: True if analyzer vectors, which include gains, have corrected the intensities.
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
    """Return four shots [4, H, W, C] by true angle, in the orientation that EXIF specifies for display."""
    turned = np.stack([apply_orientation(picture, orientation) for picture in oriented(linear, calibration)])
    return oriented(turned, orientation_calibration(orientation))


# Largest difference of the logarithms of equal exposures: files state three digits.
_EQUAL = 1e-3


def light_of_files(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[Path, float], str]:
    """Return the exposure of each file by its EXIF tags, and a warning.

    Args:
        views: files of each view.
        advance: receives the number of views that were read.

    Returns:
        The exposures of the files that state one, empty if files state different tags. The warning names the missing
        tags in that case; otherwise it is empty.

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
    """Return the relative exposures of each view by EXIF, with a geometric mean of 1, and a warning.

    Returns:
        The exposures of all views, empty if all are equal or files state different tags; and the warning of
        ``light_of_files``.
    """
    stated, missing = light_of_files(views, advance)
    logs = {path: math.log(light) for path, light in stated.items()}
    if not logs or max(logs.values()) - min(logs.values()) < _EQUAL:
        return {}, missing
    mean = sum(logs.values()) / len(logs)
    return {view: [math.exp(logs[path] - mean) for path in paths] for view, paths in views.items()}, ""


def exposure_notes(stated: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a note on the exposures that the files state."""
    if not stated:
        return []
    every = [value for exposures in stated.values() for value in exposures]
    stops = math.log2(max(every) / min(every))
    within = sum(math.log(max(exposures) / min(exposures)) >= _EQUAL for exposures in stated.values())
    return [
        f"Exposures differ by up to {stops:.2f} stops by EXIF, in {within} views from shot to shot. They are divided "
        "out (--gains none keeps them)."
    ]


def exposures_of_view(
    names: Sequence[str], gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_], stated: Sequence[float]
) -> tuple[Gains, str]:
    """Return the exposures of four shots: those of their files, unless the pair sums contradict them significantly.

    Args:
        names: names of the shots, for messages.
        gray: linear intensities [4, H, W]. usable: mask [H, W].
        stated: exposures that the files state, or ones.

    Returns:
        Gains by which the shots are divided, and a warning if the pair sums contradict the files, else "".
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
    reference = "than their EXIF exposures say" if differ else "than the other shots of the view"
    warning = (
        f"exposed differently {reference}, by the pair sums: {named}. The pair sums are used. Automatic exposure, "
        "edited pictures, or a filter that was not rotated?"
    )
    return _as_gains(np.exp(np.asarray(measured.logs) + mean)), warning


def _as_gains(values: Iterable[float]) -> Gains:
    first, second, third, fourth = map(float, values)
    return first, second, third, fourth


COMPARABLE = "Keep one kind: their brightness cannot be compared."
"""Remedy for several kinds of files in one capture or set."""


def require_one(where: Path, kinds: Iterable[tuple[str, Path]], expected: str, remedy: str) -> None:
    """Refuse pictures that differ in a property that they must share, such as their size.

    Args:
        where: folder of the pictures. kinds: value of the property and path of each file.
        expected, remedy: texts of the error.

    Raises:
        PolarguideError: two files differ. The message names the first file of each value.
    """
    first: dict[str, Path] = {}
    for name, path in kinds:
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

    Values that pile up are saturated, but do not change the full scale, which all shots of a series share.

    Args:
        values: [K, ...] stored values. bits: bits of a sensor value, if they are known.
        container, options, black, stated: as for ``levels_of_capture``.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    largest = int(values.max())
    counts = None
    # Values can pile up only if their maximum is a power of two minus 1. Counting takes longer than this test.
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
    """Return the levels of all pictures of a capture, and notes; None if every file states its full scale.

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
        outside: pixels that the alignment moved out of a shot, [H, W].
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
