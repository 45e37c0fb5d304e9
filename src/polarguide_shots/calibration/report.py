"""Report of a calibration: properties of the polarizers as a table for the console, and a picture."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.capture.sensor.pattern import Pattern
from polarguide.geometry.polarizer import ANGLES, stokes_of_four
from polarguide.visualization.figures import FONT, INK, Picture, contact_sheet, scalar_to_rgb, scale_bar
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


_CURVES = {0: (204, 51, 51), 45: (46, 134, 46), 90: (51, 102, 204), 135: (190, 120, 20)}
_HEIGHT = 340
_LEFT = 70
_RIGHT = 30
_TOP = 78
_BOTTOM = 48
_WIDTH = 1040
_GRID = (222, 222, 222)


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
    parts = (_curves(calibration, analyzers, fit, means, pattern), _maps(analyzers))
    width = max(part.shape[1] for part in parts)
    return np.concatenate(
        [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in parts]
    )


def _maps(analyzers: Sequence[Position]) -> Picture:
    """Draw throughput, extinction ratio and angle error of each block.

    The picture has a row for each angle, and three columns for each color.
    """
    colors = list(dict.fromkeys(position.color for position in analyzers))
    kinds = (
        ("throughput", "throughput", "viridis"),
        ("extinction", "extinction ratio", "magma"),
        ("angle_error", "angle error, degrees", "turbo"),
    )
    rows: list[list[Picture | None]] = [[] for _ in ANGLES]
    labels = []
    footer = []
    for (name, title, colormap), color in itertools.product(kinds, colors):
        low, high = _range(np.stack([getattr(p, name) for p in analyzers]), signed=name == "angle_error")
        labels.append(title if color is None else f"{_COLORS[color]}: {title}")
        footer.append(scale_bar(low, high, colormap))
        # Positions of a color are in the order of the angles.
        for row, position in zip(rows, (p for p in analyzers if p.color == color), strict=True):
            row.append(scalar_to_rgb(torch.from_numpy(getattr(position, name).copy()), low, high, colormap))
    return contact_sheet(
        rows,
        [f"{angle} deg" for angle in ANGLES],
        labels,
        footer=footer,
        minimum_width=256,
        maximum_width=420 if len(colors) == 1 else 256,
    )


def _range(values: Array, *, signed: bool) -> tuple[float, float]:
    """Return the lowest and highest value of a color scale, rounded outward to two digits."""
    low, high = (float(end) for end in np.percentile(values, [1, 99]))
    if signed:
        end = max(0.1, float(np.ceil(10 * max(abs(low), abs(high))) / 10))
        return -end, end
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-3 * high)))
    low = float(np.floor(low / step) * step)
    high = float(np.ceil(high / step) * step)
    return (float(f"{low:.6g}"), float(f"{high:.6g}")) if high > low else (low, low + float(step))


def _curves(
    calibration: AnalyzerCalibration,
    analyzers: Sequence[Position],
    fit: ShotFit,
    means: Array,
    pattern: Pattern,
) -> Picture:
    """Draw the mean intensity behind each analyzer as a function of the polarizer's angle, with the fit."""
    drawn: Picture = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    places = pattern.angles.ravel()
    bottom = _HEIGHT - _BOTTOM
    right = _WIDTH - _RIGHT - 330
    degrees = np.linspace(0, 180, 181)
    light = _polarized_light(np.radians(degrees))
    curves = {a: light @ fit.vectors[places == a].mean(axis=0) for a in ANGLES}
    readings = {a: means[:, places == a].mean(axis=1) / fit.levels for a in ANGLES}
    top_value = max(float(curve.max()) for curve in curves.values()) * 1.05

    def at(angle: float, value: float) -> tuple[int, int]:
        return (
            round(_LEFT + angle / 180 * (right - _LEFT)),
            round(bottom - max(0.0, value) / top_value * (bottom - _TOP)),
        )

    for angle in range(0, 181, 45):
        cv2.line(drawn, at(angle, 0), at(angle, top_value), _GRID, 1)
        _text(drawn, f"{angle}", at(angle, 0)[0] - 10, bottom + 18)
    for share in (0.0, 0.25, 0.5, 0.75):
        value = share * top_value
        cv2.line(drawn, at(0, value), at(180, value), _GRID, 1)
        _text(drawn, f"{value:.2f}", 24, at(0, value)[1] + 4)
    _text(
        drawn,
        "angle of the polarizer in degrees; share of full scale; dots are shots, curves the fit",
        _LEFT + 40,
        _HEIGHT - 10,
    )
    for angle in ANGLES:
        points = np.array([at(*point) for point in zip(degrees, curves[angle], strict=True)], np.int32)
        cv2.polylines(drawn, [points], False, _CURVES[angle], 1, cv2.LINE_AA)
        for point in zip(np.degrees(fit.angles), readings[angle], strict=True):
            cv2.circle(drawn, at(*point), 4, _CURVES[angle], -1, cv2.LINE_AA)
    lens = f", {calibration.lens}" if calibration.lens else ""
    block = calibration.block
    blocks = "single pixels" if block == calibration.pattern.period else f"blocks of {block} pixels"
    size = f"{calibration.size[0]}x{calibration.size[1]} pixels"
    _text(drawn, f"{calibration.sensor}{lens}: {size}, {blocks}", 12, 26, 0.6)
    _text(drawn, f"{len(means)} shots, misfit {fit.misfit:.2%} of their mean", 12, 50)
    _legend(drawn, analyzers, right + 24)
    return drawn


def _legend(drawn: Picture, analyzers: Sequence[Position], x: int) -> None:
    """Draw a legend with the median properties of the analyzers."""
    columns = (90, 168, 242)
    for text, place in zip(_FORMS, columns, strict=True):
        _text(drawn, text.replace("_", " "), x + place - 4, 50, 0.4)
    for line, position in enumerate(analyzers):
        y = _TOP + line * (26 if len(analyzers) == len(ANGLES) else 20)
        cv2.circle(drawn, (x + 6, y - 4), 5, _CURVES[position.angle], -1, cv2.LINE_AA)
        _text(drawn, f"{position.name} deg", x + 18, y)
        for (name, form), place in zip(_FORMS.items(), columns, strict=True):
            _text(drawn, form(np.median(getattr(position, name))), x + place, y)


def _text(drawn: Picture, text: str, x: int, y: int, scale: float = 0.45) -> None:
    ascii_text = text.encode("ascii", "replace").decode()
    cv2.putText(drawn, ascii_text, (x, y), FONT, scale, INK, 1, cv2.LINE_AA)
