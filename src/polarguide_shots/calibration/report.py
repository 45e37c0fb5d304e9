"""Report of a calibration: properties of the polarizers as a table for the console, and a picture."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.capture.sensor.pattern import Pattern
from polarguide.geometry.polarizer import ANGLES, stokes_of_four
from polarguide.visualization.figures import Picture
from polarguide_shots.calibration.shots import ShotFit

COUNTLESS = 1000.0
"""Largest extinction ratio that can be measured. Noise and the polarizer limit it."""
_COLORS = ("R", "G", "B")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Position:
    """Properties of the analyzers of one angle and color.

    Attributes:
        name: name such as "0" and "45", or "R 0" for a color sensor.
        angle: nominal angle, degrees.
        color: 0 to 2 for red, green and blue, or None for a monochrome sensor.
        throughput: throughput of each block, [rows, columns]. The local mean is 1.
        extinction: extinction ratio of each block.
        angle_error: error of the angle of each block, degrees.
    """

    name: str
    angle: int
    color: int | None
    throughput: Array
    extinction: Array
    angle_error: Array


def positions(calibration: AnalyzerCalibration) -> list[Position]:
    """Return the properties of the analyzers of a sensor, sorted by color, then by angle."""
    pattern = calibration.pattern
    colors = (None,) if pattern.colors is None else (0, 1, 2)
    rows = []
    for color, angle in itertools.product(colors, ANGLES):
        mask = pattern.angles == angle
        if color is not None and pattern.colors is not None:
            mask &= pattern.colors == color
        s0, s1, s2 = np.moveaxis(calibration.vectors[:, :, mask].astype(np.float64).mean(axis=2), -1, 0)
        strength = np.hypot(s1, s2)
        extinction = (s0 + strength) / np.maximum(s0 - strength, (s0 + strength) / COUNTLESS)
        error = np.angle(np.exp(1j * (np.arctan2(s2, s1) - 2 * np.radians(angle)))) / 2
        name = f"{angle}" if color is None else f"{_COLORS[color]} {angle}"
        rows.append(Position(name, angle, color, 2 * s0, extinction, np.degrees(error)))
    return rows


def effect(calibration: AnalyzerCalibration) -> tuple[float, float]:
    """Return the DoLP that the sensor measures without correction, for unpolarized and for fully polarized light.

    Both values are medians over the blocks. The second value is also a median over the angles of the light.
    """
    pattern = calibration.pattern
    vectors = calibration.vectors.astype(np.float64)
    zero: list[Array] = []
    full: list[Array] = []
    light = _polarized_light(np.radians(np.arange(0, 180, 15)))
    for top, left in itertools.product(range(0, pattern.period, 2), repeat=2):
        cell = vectors[:, :, top : top + 2, left : left + 2].reshape(*vectors.shape[:2], 4, 3)
        cell = cell[:, :, np.argsort(pattern.angles[top : top + 2, left : left + 2].ravel())]
        for readings, four in ((zero, cell[..., :1]), (full, cell @ light.T)):
            s0, s1, s2 = stokes_of_four(np.moveaxis(four, -2, 0))
            readings.append(np.hypot(s1, s2) / s0)
    return float(np.median(zero)), float(np.median(full))


def _polarized_light(angles: Array) -> Array:
    """Return the Stokes vectors of fully polarized light at angles in radians, [N, 3]."""
    return np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)], axis=1)


def lines(calibration: AnalyzerCalibration, analyzers: list[Position]) -> list[str]:
    """Return the lines of the table that is printed on the console."""
    rows = ["position   throughput             extinction ratio       angle error in degrees"]
    for position in analyzers:
        cells = []
        for name, form in _FORMS.items():
            values = getattr(position, name)
            low, middle, high = map(form, np.percentile(values, [5, 50, 95]))
            cells.append(middle if values.size == 1 else f"{middle} ({low} to {high})")
        rows.append(f"{position.name + ' deg':<10} " + " ".join(f"{cell:<22}" for cell in cells).rstrip())
    unpolarized, polarized = effect(calibration)
    return [
        *rows,
        "(median, and 5 % to 95 % of the blocks)",
        f"Without it, this sensor measures unpolarized light as DoLP {unpolarized:.3f}, fully polarized light as "
        f"{polarized:.3f}.",
    ]


def _ratio(value: float) -> str:
    """Format an extinction ratio."""
    return f">{COUNTLESS:.0f}" if value >= 0.999 * COUNTLESS else f"{value:.0f}"


_FORMS = {"throughput": "{:.3f}".format, "extinction": _ratio, "angle_error": "{:+.2f}".format}
"""Functions that format the properties of a position for the table."""


_KINDS = {
    "throughput": ("throughput", "viridis"),
    "extinction": ("extinction ratio", "magma"),
    "angle_error": ("angle error, degrees", "turbo"),
}
"""Label and color map of each property in the picture."""


def calibration_picture(
    calibration: AnalyzerCalibration,
    analyzers: Sequence[Position],
    fit: ShotFit,
    means: Array,
    pattern: Pattern,
) -> Picture:
    """Draw the properties of the analyzers, and the intensities of the shots with their fit.

    Args:
        calibration: the calibration.
        analyzers: properties of the analyzers.
        fit: angles and brightness of the shots.
        means: means of the shots by position, [T, K].
        pattern: pattern of the region of the shots.
    """
    columns = len(_KINDS) * len(analyzers) // len(ANGLES)
    figure = Figure(figsize=(2 + 2.6 * columns, 14), layout="constrained")
    rows = figure.add_gridspec(2, 1, height_ratios=(1, 2.5))
    top = figure.add_subfigure(rows[0])
    bottom = figure.add_subfigure(rows[1])
    lens = f", {calibration.lens}" if calibration.lens else ""
    block = calibration.block
    blocks = "single pixels" if block == calibration.pattern.period else f"blocks of {block} pixels"
    size = f"{calibration.size[0]}x{calibration.size[1]} pixels"
    top.suptitle(
        f"{calibration.sensor}{lens}: {size}, {blocks}\n{len(means)} shots, misfit {fit.misfit:.2%} of their mean",
        parse_math=False,
    )
    _draw_curves(top.subplots(), fit, means, pattern)
    _draw_maps(bottom, analyzers)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_curves(axes: Axes, fit: ShotFit, means: Array, pattern: Pattern) -> None:
    """Draw the mean intensity behind each analyzer as a function of the polarizer's angle, with the fit."""
    places = pattern.angles.ravel()
    degrees = np.linspace(0, 180, 181)
    light = _polarized_light(np.radians(degrees))
    for angle in ANGLES:
        (line,) = axes.plot(degrees, light @ fit.vectors[places == angle].mean(axis=0), label=f"{angle} deg")
        readings = means[:, places == angle].mean(axis=1) / fit.levels
        axes.plot(np.degrees(fit.angles), readings, "o", color=line.get_color())
    axes.set(
        xlabel="angle of the polarizer in degrees", ylabel="share of full scale", xticks=range(0, 181, 45)
    )
    axes.set_title("dots: shots, curves: fit", fontsize="medium")
    axes.grid(linewidth=0.3)
    axes.legend()


def _draw_maps(figure: SubFigure, analyzers: Sequence[Position]) -> None:
    """Draw the properties of each block, with a row for each angle and three columns for each color."""
    colors = list(dict.fromkeys(position.color for position in analyzers))
    grid = figure.subplots(len(ANGLES), len(_KINDS) * len(colors), squeeze=False)
    for column, (name, color) in enumerate(itertools.product(_KINDS, colors)):
        title, colormap = _KINDS[name]
        low, high = np.percentile(np.stack([getattr(p, name) for p in analyzers]), [1, 99])
        if name == "angle_error":
            high = max(-low, high)
            low = -high
        # Positions of a color are in the order of the angles.
        drawn = (position for position in analyzers if position.color == color)
        for axes, position in zip(grid[:, column], drawn, strict=True):
            values = getattr(position, name)
            image = axes.imshow(values, vmin=low, vmax=high, cmap=colormap)
            axes.set_title(
                f"{position.name} deg, median {_FORMS[name](np.median(values))}", fontsize="medium"
            )
            axes.set_axis_off()
        figure.colorbar(image, ax=list(grid[:, column]), location="bottom", label=title)
