"""The noise of a sensor: given, or estimated from the redundancy of the four angles of one shot."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, demosaic
from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.capture.view import ANGLES
from polarguide.shots.maps import NoiseModel
from polarguide.shots.options import ShotOptions

_SAMPLES = 400_000
_BINS = 24
_FEWEST = 200
_REACH = 16
"""Pixels between two impulses, more than twice what any interpolation reaches."""


def given_noise(options: ShotOptions, step: float) -> NoiseModel | None:
    """The model of the options, None where they give none. ``step``: one stored value as a share of full scale."""
    if options.full_well is None:
        return None
    read = options.read_noise / options.full_well
    return NoiseModel(read * read + step * step / 12, 1 / options.full_well, "given")


def estimated_noise(intensities: Any, usable: NDArray[np.bool_], step: float) -> NoiseModel:
    """Fit ``floor + slope * intensity`` to how far ``I0 + I90`` is off ``I45 + I135``.

    Four angles measure three unknowns: the difference is zero but for noise, whose variance it has four times (linear
    gradients cancel, too, in a cell of four pixels). Its spread is taken about the median in bins of brightness, so
    that unequal gains do not count, and by the median of absolute differences, so that edges hardly do.

    Args:
        intensities: four arrays [N] (or any one shape), by angle; of cells or of pixels.
        usable: in this shape, neither dark nor saturated.
        step: one stored value as a share of full scale; less noise than it hides is not believed.
    """
    chosen = np.flatnonzero(usable)
    chosen = chosen[:: max(1, len(chosen) // _SAMPLES)]
    least = step * step / 12
    if len(chosen) < _FEWEST:
        return NoiseModel(least, 0.0, "estimated")
    i0, i45, i90, i135 = (np.ravel(i)[chosen].astype(np.float64) for i in intensities)
    mean, excess = (i0 + i45 + i90 + i135) / 4, i0 + i90 - i45 - i135
    # Whole numbers have no fine quantiles: even noise of one step makes them so, and is taken off again.
    excess += np.random.default_rng(0).uniform(-0.5, 0.5, len(excess)) * step
    parts = np.array_split(np.argsort(mean), min(_BINS, max(1, len(mean) // _FEWEST)))
    levels, spreads = [], []
    for part in parts:
        off = np.abs(excess[part] - np.median(excess[part]))
        levels.append(float(mean[part].mean()))
        spreads.append(max(((1.4826 * float(np.median(off))) ** 2 - least) / 4, least))
    return NoiseModel(*_line(np.array(levels), np.array(spreads), least), "estimated")


def _line(x: NDArray[np.float64], y: NDArray[np.float64], least: float) -> tuple[float, float]:
    """Floor and slope, neither negative, of the line through variances; errors of a variance grow with it."""
    weight, floor, slope = 1 / y, float(y.mean()), 0.0
    for _ in range(3):
        matrix = np.stack([np.ones_like(x), x], axis=1) * weight[:, None]
        (floor, slope), *_ = np.linalg.lstsq(matrix, y * weight, rcond=None)
        if slope < 0:
            floor, slope = float((y * weight**2).sum() / (weight**2).sum()), 0.0
        elif floor < least:
            floor, slope = least, float((((y - least) * x) * weight**2).sum() / ((x * weight) ** 2).sum())
        weight = 1 / np.maximum(floor + slope * x, least)
    return max(float(floor), least), max(float(slope), 0.0)


@lru_cache(maxsize=8)
def interpolation_factors(sensor: str, x: int, y: int, mode: str) -> NDArray[np.float32]:
    """Variance of each developed intensity, as a multiple of a sample's: [4, p, p] over a period p of the pattern.

    Interpolated values are means of samples, which have less noise; each is read from what an impulse at every position
    of the pattern becomes, by the demosaicing itself. Guided interpolation, which is not linear, is taken to be
    bilinear, and luminance as the mean of the colors. ``x`` and ``y`` are where the pattern of the sensor begins.
    """
    pattern = sensor_pattern(sensor).shifted(x, y)
    side, step = 4 * _REACH, DEMOSAIC_MODES[mode]
    period, cell = max(1, pattern.period // step), max(pattern.period, step)
    # Half size is the mean over cells of full size, but for S0, of whose noise DoLP and AoLP hardly depend.
    way = "quarter" if mode == "quarter" else "full"
    squares = np.zeros((len(ANGLES), side // step, side // step))
    for row, column in np.ndindex(cell, cell):
        picture = np.zeros((side, side), np.float32)
        picture[row::_REACH, column::_REACH] = 1
        nothing = np.zeros(picture.shape, bool)
        done = demosaic(
            picture, nothing, pattern, mode=way, interpolation="bilinear", colored=False
        ).intensities
        response = done.mean(axis=-1, dtype=np.float64)
        if mode == "half":
            response = response.reshape(len(ANGLES), side // 2, 2, side // 2, 2).mean(axis=(2, 4))
        # Impulses of one position lie so far apart that no pixel sees two.
        squares += response**2
    inner = slice(_REACH // step, 2 * _REACH // step)
    found = squares[:, inner, inner]
    blocks = found.reshape(4, found.shape[1] // period, period, found.shape[2] // period, period)
    return np.asarray(blocks.sum(axis=(1, 3)), np.float32)
