"""Compute linear intensities from camera files: mosaics of a polarization sensor, and shots through a filter.

The functions work for whole captures and for single shots. Levels and exposures are estimated from all pictures that
the caller passes together.
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

from polarguide.capture.brackets import (
    NORMAL,
    SINGLE,
    Bracket,
    MergedExposures,
    Radiance,
    measure_exposures,
    merge,
)
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
    RawFormat,
    estimate_levels,
    level_notes,
    read_mosaic,
    require_mosaic,
    sensor_pattern,
    tiled,
    unusable_samples,
)
from polarguide.capture.view import FULL_CODE
from polarguide.capture.view_reader import require_alike
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import require_file
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES

QUARTER_FLIPS = ("90", "270")
"""Values of the option ``flip`` that specify a rotation by 90 degrees or 270 degrees counter-clockwise."""
SMALLEST = 16
"""Smallest length of the shorter side of a mosaic in pixels."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Number of bytes per sensor pixel that the development of a mosaic takes at least, by demosaicing mode."""


class MosaicFiles:
    """Reader of the raw mosaics of one sensor, which also converts their values to linear intensities.

    Attributes:
        pattern: pattern of the sensor, starting at the top-left pixel of a mosaic after ``cut``.
        crop: number of columns and rows that ``cut`` removes at the left and top.
        corner: column and row of the sensor at which a mosaic starts after ``cut``.
        analyzers: calibration of the sensor, or None.
    """

    def __init__(self, options: RawMosaicOptions) -> None:
        """Create a reader with the sensor, region, packing, dark frame and calibration of the options.

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
        """Read the stored values [H, W] of a whole mosaic, and return them in the orientation of the sensor.

        Args:
            where: path of the file, or a name for messages if the mosaic is in memory.
            values: mosaic in memory, uint8 or uint16. By default, the file ``where`` is read.

        Raises:
            PolarguideError: the file is unreadable, too small, or a grid of four pictures. Or the mosaic does not fit
                into memory, or is larger than the calibrated region.
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
        """Undo the mirroring or rotation of a mosaic that the option ``flip`` specifies.

        Raises:
            PolarguideError: the mosaic is wider or higher than the sensor, possibly because it was rotated.
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
        """Return the number of bits per pixel in a file, and the full scale that the file states.

        The full scale is ``None`` if the file does not state it, or if the user specifies ``bits``.
        """
        stated = self._raw.full_scale(path, values) if self._options.bits is None else None
        return self._raw.container(path, values.dtype), stated

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop a mosaic [H, W] so that it consists of whole polarizer cells."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """Return the dark frame, cropped by ``cut``. Return None if the user specifies no dark frame."""
        if self._options.dark_frame is None:
            return None
        dark = self._turned_back(self._options.dark_frame, read_mosaic(self._options.dark_frame, self._raw))
        require(
            dark.shape == shape,
            self._options.dark_frame,
            expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
            found=f"{dark.shape[1]}x{dark.shape[0]}",
            remedy="Photograph it with the same region and settings, and with the lens covered.",
        )
        return self.cut(dark).astype(np.float32)

    def ratio_of_blocks(
        self,
        samples: list[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        shape: tuple[int, ...],
    ) -> float | None:
        """Measure the ratio of the pair sums in blocks of mosaics.

        Samples of different angles are at different pixels. Tent weights interpolate all of them to the center of
        a block of two periods, so gradients of the picture cancel in the ratio.

        Args:
            samples: blocks with a side of two periods from each mosaic, see ``sample_blocks``.
            levels: levels of the stored values.
            dark: dark frame, or None.
            shape: numbers of rows and columns of a mosaic after ``cut``.

        Returns:
            The ratio (I0 + I90) / (I45 + I135), or None if the blocks are too dark.
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
        # The weights of each angle sum to the number of its samples in a period.
        angles = np.stack([weighted[:, places == angle].sum(axis=1) for angle in ANGLES])
        angles *= 4 / period**2
        base = levels.black if floor is None else floor
        usable = np.asarray((values < levels.saturation).all(axis=(1, 2)) & (values > base).any(axis=(1, 2)))
        return pair_ratio(angles, usable)

    def merged(
        self,
        bracket: Bracket,
        exposures: Sequence[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        part: tuple[slice, slice] | None = None,
    ) -> tuple[Radiance, NDArray[np.bool_]]:
        """Convert the stored values of a mosaic to linear intensities, and merge its exposures.

        Args:
            bracket: files of the exposures.
            exposures: stored values of each exposure after ``cut``, [H, W].
            levels: levels of the stored values.
            dark: dark frame [H, W], or None.
            part: rows and columns of the result; default: all. The exposures are measured in the whole mosaic.

        Returns:
            The linear intensities [H, W]; and the mask of samples that are dark in all exposures.

        Raises:
            PolarguideError: the exposures contradict each other, see ``measure_exposures``.
        """

        def linear(
            data: tuple[NDArray[Any], NDArray[np.float32] | None],
        ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            return levels.linear(*data), np.asarray(data[0] >= levels.saturation)

        measured = measure_exposures(bracket, [(values, dark) for values in exposures], linear)
        if part is not None:
            exposures = [np.ascontiguousarray(values[part]) for values in exposures]
            dark = None if dark is None else dark[part]
        radiance = merge([(values, dark) for values in exposures], linear, measured)
        black = [unusable_samples(values, levels, dark)[1] for values in exposures]
        return radiance, np.logical_and.reduce(black)

    def calibrated(
        self,
        linear: NDArray[np.float32],
        *masks: NDArray[np.bool_],
        corner: tuple[int, int] | None = None,
    ) -> tuple[NDArray[np.float32], tuple[NDArray[np.bool_], ...]]:
        """Apply the calibration to the linear intensities of a mosaic or a part of it.

        The calibration mixes the samples of a polarizer cell. If there is a calibration, masks of unusable samples are
        therefore extended to whole cells.

        Args:
            linear: linear intensities [H, W].
            masks: masks of unusable samples, [H, W] each.
            corner: column and row of the sensor at which the part starts; default: ``corner`` of the reader.

        Returns:
            The linear intensities [H, W], and the masks.
        """
        if self.analyzers is None:
            return linear, masks
        return self.analyzers.apply(linear, offset=corner or self.corner), tuple(map(spread_to_cells, masks))

    def sample_factors(
        self, shape: tuple[int, ...], gains: Sequence[float], scale: float = 1.0
    ) -> NDArray[np.float32]:
        """Return the factor by which each sample of a mosaic is multiplied, ``scale / gain`` of its angle, [H, W]."""
        of_angle = dict(zip(ANGLES, gains, strict=True))
        factors = np.vectorize(lambda angle: scale / of_angle[angle])(self.pattern.angles)
        return tiled(factors.astype(np.float32), shape)


def calibration_of(options: RawMosaicOptions) -> AnalyzerCalibration | None:
    """Read the calibration of the sensor. Return None if the options specify no calibration.

    The calibration is cached because many mosaics use it.

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
    """Return N square blocks of a mosaic in a regular grid, [N, size, size]."""
    rows = values.shape[0] // size
    columns = values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    row, column = np.divmod(np.arange(0, rows * columns, max(1, rows * columns // _BLOCKS)), max(columns, 1))
    return grid.swapaxes(1, 2)[row, column]


LARGE_IMBALANCE = 0.01
"""Relative difference of the pair sums above which the user gets a note if it is not corrected."""


def pair_gains(
    ratio: float | None, options: GainOptions, notes: Mapping[str, str], *, calibrated: bool = False
) -> tuple[Gains, list[str]]:
    """Choose the gains of the four angles, and describe the choice for the user.

    Args:
        ratio: ratio (I0 + I90) / (I45 + I135) of the pair sums; None if the pictures are too dark.
        options: options of the user. The gains in ``calibration`` take precedence over the option ``gains``.
        notes: text of the note for each outcome, with a placeholder for the ratio minus 1. The outcomes are "dark",
            "off" if the ratio is too large for gains, "corrected", and "left" if a large ratio is not corrected.
        calibrated: True if the intensities were corrected with analyzer vectors, which include the gains.

    Returns:
        The gains, and notes for the user.
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
    """Convert four shots to displayed angles of 0, 45, 90 and 135 degrees, and rotate them for display.

    Args:
        linear: linear intensities of the shots, [4, H, W, C].
        calibration: order, sense and zero of the angles.
        orientation: EXIF orientation of the shots.
    """
    turned = np.stack([apply_orientation(picture, orientation) for picture in oriented(linear, calibration)])
    return oriented(turned, orientation_calibration(orientation))


# Largest difference of the logarithms of two equal exposures. Files state exposures with three digits.
_EQUAL = 1e-3


def light_of_files(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[Path, float], str]:
    """Read the exposure of each shot from EXIF tags.

    The exposures of a bracket become one value: the exposure at which the merged radiance 1 is full scale.

    Args:
        views: files of each view, which represent its shots.
        advance: callback for the number of views that were read.

    Returns:
        The exposures of the shots whose files state an exposure; and a warning, or "". If some files lack a tag that
        others have, exposures cannot be compared. The result is then empty, and the warning names the missing tags.

    Raises:
        PolarguideError: a file cannot be read, or the shots of a view have different exposures.
    """
    taken: dict[Path, ExposureData] = {}
    scales: dict[Path, tuple[Path, float]] = {}
    for number, paths in enumerate(views.values(), 1):
        bracket = Bracket.of(paths)
        taken |= {file: read_exposure_data(file) for files in bracket.files for file in files}
        scale = 2.0 ** -(bracket.stops or (0.0,))[bracket.normal]
        scales |= {
            path: (file, scale) for path, file in zip(paths, bracket.files[bracket.normal], strict=True)
        }
        if advance is not None:
            advance(number)
    missing = missing_tags(taken)
    if missing:
        return {}, missing
    stated = {path: (taken[file].light, scale) for path, (file, scale) in scales.items()}
    return {path: light * scale for path, (light, scale) in stated.items() if light is not None}, ""


def stated_exposures(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[str, list[float]], str]:
    """Read the relative exposures of the pictures of each view from EXIF tags. Their geometric mean is 1.

    Returns:
        The exposures of all views; and the warning of ``light_of_files``. The exposures are empty if all of them are
        equal, or if the files cannot be compared.
    """
    stated, missing = light_of_files(views, advance)
    logs = {path: math.log(light) for path, light in stated.items()}
    if not logs or max(logs.values()) - min(logs.values()) < _EQUAL:
        return {}, missing
    mean = sum(logs.values()) / len(logs)
    return {view: [math.exp(logs[path] - mean) for path in paths] for view, paths in views.items()}, ""


def exposure_notes(stated: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a note for the user about the exposures that the files state."""
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
    """Choose the exposures of the four shots of a view.

    The exposures that the files state are used, unless the pair sums of the shots contradict them significantly.

    Args:
        names: names of the shots for messages.
        gray: linear intensities [4, H, W].
        usable: mask of usable pixels, [H, W].
        stated: exposures that the files state; 1 if they state no exposure.

    Returns:
        The gains by which the shots are divided; and a warning if the pair sums contradict the files, otherwise "".
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
"""Remedy in the error for different kinds of files in one capture or view."""


def require_one(where: Path, kinds: Iterable[tuple[str, Path]], expected: str, remedy: str) -> None:
    """Refuse pictures that differ in a property that must be equal, such as their size.

    Args:
        where: folder of the pictures.
        kinds: value of the property and path of each file.
        expected: text of the error.
        remedy: text of the error.

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
    """Estimate the levels (such as full scale) of the stored values of a capture.

    Args:
        counts: number of occurrences of each stored value, starting at the value 0.
        container: number of bits of a value in the files.
        options: options ``bits`` and ``saturation`` of the user.
        black: stored value without light.
        stated: full scale that all files state, or None.

    Returns:
        The levels, and notes for the user.

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
    """Estimate the levels (such as full scale) of the stored values of a single shot.

    If many samples have the same largest value, they are saturated. This value does not become the full scale, because
    all shots of a series must have the same full scale.

    Args:
        values: stored values, [K, ...].
        container: see ``levels_of_capture``.
        options: see ``levels_of_capture``.
        bits: number of bits of a sensor value, or None if it is unknown.
        black: see ``levels_of_capture``.
        stated: see ``levels_of_capture``.

    Returns:
        The levels, and notes for the user.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    largest = int(values.max())
    counts = None
    # Clipped values are a power of two minus 1. This test avoids the slow counting of all values.
    may_pile_up = container == 16 and largest < FULL_16 and largest & (largest + 1) == 0
    if may_pile_up and options.bits is None and options.saturation is None:
        parts = (np.bincount(part.ravel(), minlength=FULL_16 + 1) for part in values)
        counts = sum(parts, np.zeros(1, np.int64))
    levels = estimate_levels(
        largest, int(np.bitwise_or.reduce(values, None)), container,
        bits=bits, black=black, saturation=options.saturation, counts=counts, stated=stated, alone=True,
    )  # fmt: skip
    return levels, level_notes(levels, counts, container, bits, stated)


def levels_of_pictures(paths: Sequence[Path], options: SampledOptions) -> tuple[Levels | None, list[str]]:
    """Estimate the levels (such as full scale) of the stored values of all pictures of a capture.

    Args:
        paths: files of the capture.
        options: options ``bits`` and ``saturation`` of the user.

    Returns:
        The levels, and notes for the user. The levels are ``None`` if the full scale of each file is known.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    wide = [path for path in paths if not is_camera_raw(path) and may_use_fewer_bits(path)]
    if not wide and options.bits is None and options.saturation is None:
        return None, []
    counts = np.zeros(FULL_16 + 1, np.int64)
    container = 8
    for path in wide or paths:
        values = read_stack([path]).pictures
        container = 8 * values.dtype.itemsize
        counts += np.bincount(values.ravel(), minlength=len(counts))
    levels, notes = levels_of_capture(counts, container, options)
    return levels, [] if levels.is_full(container) else notes


@dataclass(frozen=True, eq=False)
class BracketedShots:
    """Stored pixels of the K shots of a view at E exposures.

    Attributes:
        bracket: files of the exposures.
        shots: stored pixels at each exposure.
    """

    bracket: Bracket
    shots: Sequence[Shots]

    @classmethod
    def single(cls, shots: Shots) -> BracketedShots:
        """Use shots with one exposure."""
        return cls(SINGLE, [shots])

    @classmethod
    def read(cls, paths: Sequence[Path], levels: Levels | None = None) -> BracketedShots:
        """Read all exposures of the shots that some files represent. ``read_stack`` describes the arguments.

        Raises:
            PolarguideError: a file cannot be read, or files differ in size, depth, orientation or exposures.
        """
        bracket = Bracket.of(paths)
        shots = [read_stack(files, levels) for files in bracket.files]
        for files, others in zip(bracket.files, shots, strict=True):
            require_alike(files[0], others.pictures[0], bracket.files[0][0], shots[0].pictures[0])
        return cls(bracket, shots)


@dataclass(frozen=True, eq=False)
class LinearShots:
    """Linear intensities of the K shots of a view. If there are four shots, they may be aligned.

    Attributes:
        values: linear intensities, [K, H, W, 3]; full scale of the normal exposure is 1.
        saturated: mask of the pixels that are saturated in some shot, [H, W].
        dark: mask of the pixels that are 0 in all shots, [H, W].
        outside: mask of the pixels that are outside the picture of some shot after the alignment, [H, W].
        shifts: estimated shifts of the shots.
        orientation: EXIF orientation of the shots.
        clipped_share: share of the saturated pixels before the alignment.
        dark_share: share of the dark pixels before the alignment.
        exposures: exposures that were merged.
    """

    values: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    dark: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    shifts: list[Shift]
    orientation: int
    clipped_share: float
    dark_share: float
    exposures: MergedExposures = NORMAL

    @property
    def invalid(self) -> NDArray[np.bool_]:
        """Mask of the pixels that are saturated, dark or outside the picture of a shot, [H, W]."""
        return self.saturated | self.dark | self.outside

    @classmethod
    def of(cls, exposures: BracketedShots, transfer: str, *, align: bool) -> LinearShots:
        """Convert the stored values of shots to linear intensities, and merge their exposures.

        Shifts of the shots are corrected if ``align``.

        Raises:
            PolarguideError: the exposures contradict each other, see ``measure_exposures``.
        """

        def linear(shots: Shots) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            codes = linear_codes(shots.pictures, transfer)
            return codes.astype(np.float32) / np.float32(FULL_CODE), shots.clipped

        measured = measure_exposures(exposures.bracket, exposures.shots, linear)
        radiance = merge(exposures.shots, linear, measured)
        values = radiance.values
        clipped = radiance.clipped
        no_light = np.logical_and.reduce([shots.dark for shots in exposures.shots])
        # Highlights must not dominate the correlation of the shots.
        shifts = estimate_shifts(np.minimum(values, 1.0)) if align else [Shift(0.0, 0.0, True)] * len(values)
        values, (saturated, dark), outside = align_shots(values, (clipped, no_light), shifts)
        return cls(
            values,
            saturated,
            dark,
            outside,
            shifts,
            exposures.shots[0].orientation,
            float(clipped.any(axis=0).mean()),
            float(no_light.mean()),
            radiance.exposures,
        )

    def evenly_exposed(
        self, names: Sequence[str], stated: Sequence[float], options: GainOptions
    ) -> tuple[NDArray[np.float32], Gains, str]:
        """Divide four shots by their exposures.

        Args:
            names: names of the shots for messages.
            stated: exposures that the files state; 1 if they state no exposure.
            options: options of the user. If ``gains`` is auto and no calibration specifies gains, the exposures are
                also measured from the pair sums.

        Returns:
            The divided intensities, the exposures, and the warning of ``exposures_of_view``.
        """
        exposures = _as_gains(stated)
        warning = ""
        if options.gains == "auto" and options.calibration.gains is None:
            exposures, warning = exposures_of_view(names, self.values.mean(axis=3), ~self.invalid, stated)
        return self.values / np.asarray(exposures, np.float32)[:, None, None, None], exposures, warning
