"""From a raw mosaic to linear intensities at four angles: all of it, or a part."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import UNIT_GAINS, Calibration, oriented, pair_ratio
from polarguide.capture.sensor.analyzer_file import read_analyzers
from polarguide.capture.sensor.analyzers import AnalyzerCalibration, spread_to_cells
from polarguide.capture.sensor.defects import defects, defects_note
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, demosaic, spoiled
from polarguide.capture.sensor.pattern import (
    SENSOR_SIZE,
    SIDE,
    Levels,
    Pattern,
    estimate_levels,
    tiled,
    unusable_samples,
)
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_file
from polarguide.preparation.mosaic_source import MosaicFiles, block_intensities, sample_blocks
from polarguide.shots.developed import Developed, Mask, Part, gains_of
from polarguide.shots.exposures import ExposureSet
from polarguide.shots.maps import (
    Map,
    NoiseModel,
    averaged_factor,
    estimated_noise,
    given_noise,
    interpolation_factors,
)
from polarguide.shots.options import ShotOptions
from polarguide.shots.samples import piled_up

AROUND = 32
"""Pixels around a part that are developed with it: more than any interpolation reaches."""


def develop_mosaic(shot: ExposureSet, options: ShotOptions, part: Part | None) -> Developed:
    files = MosaicFiles(options.preparation())
    stored, container = _stored(shot, files)
    pattern = files.pattern
    _require_on_sensor(shot.where, stored.shape, options)
    dark = files.dark(stored.shape)
    values = files.cut(stored)
    levels, notes = _levels_of(stored, container, options)
    files.require_kind(sample_blocks(values, SIDE), levels)
    assert options.sensor is not None
    x, y = options.offset_x + files.crop[0], options.offset_y + files.crop[1]
    analyzers = _analyzers(stored.shape, options)
    ratio = _ratio_of(values, dark, levels, pattern, None if analyzers is None else (analyzers, (x, y)))
    gains, said = gains_of(ratio, options)
    mode, way = options.demosaic, options.interpolation
    step = DEMOSAIC_MODES[mode]
    cut = _cut(part, values.shape, step)
    whole = (values.shape[1] // step, values.shape[0] // step) if cut is not None else None
    if cut is not None:  # what is judged of the shot as a whole is judged
        values, dark = np.ascontiguousarray(values[cut]), None if dark is None else dark[cut]
        x, y = x + cut[1].start, y + cut[0].start
    saturated, black = unusable_samples(values, levels, dark)
    defective = defects([np.minimum(values, levels.white)], pattern.period)
    notes += [defects_note(int(defective.sum()), values.size)] if defective.any() else []
    linear = levels.linear(values, dark)
    if analyzers is not None:
        linear = analyzers.apply(linear, offset=(x, y))
        saturated, black, defective = map(spread_to_cells, (saturated, black, defective))
    if gains != UNIT_GAINS:
        of_angle = dict(zip(ANGLES, gains, strict=True))
        linear *= tiled(np.vectorize(lambda a: np.float32(1 / of_angle[a]))(pattern.angles), linear.shape)
    lsb = 1 / (levels.white - levels.black)
    noise = given_noise(options, lsb) or _noise_of(linear, saturated | black | defective, pattern, lsb)
    picture = demosaic(linear, saturated, pattern, mode=mode, interpolation=way, colored=False)
    dark_pixels, masked = (
        spoiled(samples, pattern, mode=mode, interpolation=way) for samples in (black, defective)
    )
    return Developed(
        intensities=oriented(picture.intensities, options.calibration),
        dark=dark_pixels,
        saturated=picture.invalid,
        masked=masked,
        noise=noise,
        factors=_placed(interpolation_factors(options.sensor, x, y, mode), options.calibration),
        mean_variance=averaged_factor(options.sensor, x, y, mode),
        pair_ratio=ratio,
        notes=(*notes, *said),
        origin=(0, 0) if cut is None else (cut[1].start // step, cut[0].start // step),
        whole=whole,
    )


def _stored(shot: ExposureSet, files: MosaicFiles) -> tuple[NDArray[Any], int]:
    """The values of a mosaic, and the bits that one takes where it is stored."""
    if shot.stored is not None:
        return files.given(shot.stored, shot.name), 8 * shot.stored.dtype.itemsize
    path = shot.files[0]
    stored = files.read(path)
    return stored, files.container(path, stored)


def _levels_of(stored: NDArray[Any], container: int, options: ShotOptions) -> tuple[Levels, list[str]]:
    """Black, full scale and saturation of a mosaic, and notes of what was not stated."""
    levels = estimate_levels(
        int(stored.max()),
        int(np.bitwise_or.reduce(stored, None)),
        container,
        bits=options.bits,
        black=options.black_level,
        saturation=options.saturation,
    )
    notes = []
    if options.bits is None and container == 16:
        notes.append(f"Values fill {levels.bits} bits (--bits says otherwise); {levels.white} is full scale.")
    pile, piled = piled_up(stored, container, options)
    if pile is not None and pile < levels.saturation:
        levels, notes = replace(levels, saturation=pile), [*notes, *piled]
    return replace(levels, gamma=options.gamma), notes


def _ratio_of(
    values: NDArray[Any],
    dark: NDArray[np.float32] | None,
    levels: Levels,
    pattern: Pattern,
    corrected: tuple[AnalyzerCalibration, tuple[int, int]] | None,
) -> float | None:
    """The ratio of the pair sums; ``corrected``: by a calibration, from this column and row of the sensor on."""
    side, matrices = 2 * pattern.period, None
    if corrected is not None:
        of_cells = corrected[0].correction(corrected[1], values.shape[::-1])
        matrices = np.stack([[sample_blocks(cell, pattern.period) for cell in row] for row in of_cells])
    floor = None if dark is None else sample_blocks(dark, side)
    angles, _, usable = block_intensities([sample_blocks(values, side)], levels, floor, pattern, matrices)
    return pair_ratio(angles, usable)


def _noise_of(linear: NDArray[np.float32], bad: Mask, pattern: Pattern, lsb: float) -> NoiseModel:
    """The noise of the samples that are not ``bad``."""
    cells = {int(pattern.angles[r, c]): linear[r::2, c::2] for r, c in np.ndindex(2, 2)}
    good = ~(bad[::2, ::2] | bad[1::2, ::2] | bad[::2, 1::2] | bad[1::2, 1::2])
    return estimated_noise([cells[angle] for angle in ANGLES], good, lsb)


def _cut(part: Part | None, shape: tuple[int, ...], step: int) -> tuple[slice, slice] | None:
    """The samples of a mosaic that a part of its picture needs: whole superpixels, with ``AROUND`` around them.

    Args:
        part: of the picture. shape: of the mosaic, rows and columns. step: samples of a pixel, each way.

    Returns:
        Rows and columns; None for all, where hardly any would be left out.
    """
    if part is None:
        return None
    ends = []
    for begin, length, most in ((part[1], part[3], shape[0]), (part[0], part[2], shape[1])):
        low = max(0, begin * step - AROUND) // 8 * 8
        ends.append(slice(low, max(low, min(most, -(-((begin + length) * step + AROUND) // 8) * 8))))
    rows, columns = ends
    area = (rows.stop - rows.start) * (columns.stop - columns.start)
    return (rows, columns) if 0 < 2 * area <= shape[0] * shape[1] else None


def _analyzers(shape: tuple[int, ...], options: ShotOptions) -> AnalyzerCalibration | None:
    """The calibration of the sensor, checked against what it is to correct; read once for all shots."""
    path = options.analyzers
    if path is None:
        return None
    found = calibration_of(path)
    found.require_sensor(options.sensor, path)
    found.require_region((options.offset_x, options.offset_y), (shape[1], shape[0]), path)
    return found


def calibration_of(path: Path) -> AnalyzerCalibration:
    require_file(path, expected="a file of polarguide calibrate", remedy="Check --calibration.")
    state = path.stat()
    return _read(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=1)
def _read(path: Path, *_: int) -> AnalyzerCalibration:
    return read_analyzers(path)


def _require_on_sensor(path: Path | str, shape: tuple[int, ...], options: ShotOptions) -> None:
    """Refuse what is larger than the sensor: another one, or no mosaic."""
    most = tuple(n - o for n, o in zip(SENSOR_SIZE, (options.offset_x, options.offset_y), strict=True))
    if shape[1] > most[0] or shape[0] > most[1]:
        raise PolarguideError(
            path,
            expected=f"at most {most[0]}x{most[1]} pixels of {options.sensor}",
            found=f"{shape[1]}x{shape[0]}",
            remedy="Check --sensor, --offset-x and --offset-y; prepare reads larger sensors of the same pattern.",
        )


def _placed(factors: Map, calibration: Calibration) -> Map:
    """The factors by true angle."""
    if calibration.permutes:
        return oriented(factors, calibration)
    return np.broadcast_to(factors.mean(axis=0), factors.shape)
