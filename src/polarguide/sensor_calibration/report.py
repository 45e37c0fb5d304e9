"""What the analyzers of a sensor are like: throughput, extinction ratio and angle error by position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.polarizer import ANGLES, stokes_of_four

COUNTLESS = 1000.0
"""Extinction ratios above this are not told apart: noise and the polarizer decide them."""
_COLORS = ("R", "G", "B")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Position:
    """The analyzers at one angle, behind one color.

    Attributes:
        name: "0", "45", ... or "R 0", ...
        angle: nominal, degrees. color: 0 to 2, None for a monochrome sensor.
        throughput: 1 is the mean around it; extinction: ratio; angle_error: degrees; all by block, [rows, columns].
    """

    name: str
    angle: int
    color: int | None
    throughput: Array
    extinction: Array
    angle_error: Array


def positions(calibration: AnalyzerCalibration) -> list[Position]:
    """The positions of a sensor, colors first, then by angle."""
    pattern = calibration.pattern
    colors = (None,) if pattern.colors is None else (0, 1, 2)
    found = []
    for color in colors:
        for angle in ANGLES:
            chosen = pattern.angles == angle
            if color is not None and pattern.colors is not None:
                chosen &= pattern.colors == color
            vectors = calibration.vectors[:, :, chosen].astype(np.float64).mean(axis=2)
            name = f"{angle}" if color is None else f"{_COLORS[color]} {angle}"
            found.append(Position(name, angle, color, *_measures(vectors, np.radians(angle))))
    return found


def _measures(vectors: Array, nominal: float) -> tuple[Array, Array, Array]:
    s0, s1, s2 = np.moveaxis(vectors, -1, 0)
    strength = np.hypot(s1, s2)
    least = (s0 + strength) / COUNTLESS
    extinction = (s0 + strength) / np.maximum(s0 - strength, least)
    turn = np.angle(np.exp(1j * (np.arctan2(s2, s1) - 2 * nominal))) / 2
    return 2 * s0, extinction, np.degrees(turn)


def spread(values: Array) -> tuple[float, float, float]:
    """Median, 5th and 95th percentile."""
    low, middle, high = np.percentile(values, [5, 50, 95])
    return float(middle), float(low), float(high)


def effect(calibration: AnalyzerCalibration) -> tuple[float, float]:
    """What the sensor reads without correction: the DoLP of unpolarized light, and of fully polarized light.

    Both are medians over the blocks, the latter over angles of the light, too.
    """
    pattern = calibration.pattern
    vectors = calibration.vectors.astype(np.float64)
    corners = range(0, pattern.period, 2)
    zero, full = [], []
    turns = np.radians(np.arange(0, 180, 15))
    light = np.stack([np.ones_like(turns), np.cos(2 * turns), np.sin(2 * turns)], axis=1)
    for top in corners:
        for left in corners:
            cell = vectors[:, :, top : top + 2, left : left + 2].reshape(*vectors.shape[:2], 4, 3)
            places = [int(a) for a in pattern.angles[top : top + 2, left : left + 2].ravel()]
            cell = cell[:, :, [places.index(angle) for angle in ANGLES]]
            zero.append(_dolp(np.moveaxis(cell[..., 0], -1, 0)))
            full.append(_dolp(np.moveaxis(cell @ light.T, -2, 0)))
    return float(np.median(zero)), float(np.median(full))


def _dolp(four: Array) -> Array:
    s0, s1, s2 = stokes_of_four(four)
    return np.asarray(np.hypot(s1, s2) / s0)


def lines(calibration: AnalyzerCalibration, said: list[Position]) -> list[str]:
    """The table for the console."""
    rows = ["position   throughput             extinction ratio       angle error in degrees"]
    for position in said:
        cells = [
            _cell(position.throughput, "{:.3f}"),
            _cell(position.extinction, "{:.0f}"),
            _cell(position.angle_error, "{:+.2f}"),
        ]
        rows.append(f"{position.name + ' deg':<10} " + " ".join(f"{cell:<22}" for cell in cells).rstrip())
    unpolarized, polarized = effect(calibration)
    rows.append("(median, and 5 % to 95 % of the blocks)")
    rows.append(
        f"Without it this sensor reads unpolarized light as DoLP {unpolarized:.3f}, fully polarized light as "
        f"{polarized:.3f}."
    )
    return rows


def _cell(values: Array, form: str) -> str:
    def text(value: float) -> str:
        return f">{COUNTLESS:.0f}" if form == "{:.0f}" and value >= 0.999 * COUNTLESS else form.format(value)

    middle, low, high = spread(values)
    return text(middle) if values.size == 1 else f"{text(middle)} ({text(low)} to {text(high)})"
