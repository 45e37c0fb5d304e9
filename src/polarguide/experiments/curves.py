"""Training curves as inline SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.runs.folder import RunLog

Numbers = NDArray[np.float64]

WIDTH, HEIGHT = 860, 340
LEFT, RIGHT, TOP, BOTTOM = 56, 16, 14, 46
POINTS = 240
SMOOTHED_SHARE = 0.05
"""Share of a training over which a curve is averaged: single steps show single views, which differ by decibels."""
COLORS = 8
"""How many colors the style sheet has; further curves repeat them dashed, then dotted."""
DASHES = ("", "7 4", "2 3")


@dataclass(frozen=True, eq=False)
class Curve:
    """PSNR in dB [P] over step and seconds [P] of one run, smoothed."""

    name: str
    steps: Numbers
    seconds: Numbers
    psnr: Numbers


def read_curve(run: Path, name: str) -> Curve | None:
    """The curve of a run by its log, at most ``POINTS`` points; None where there is no line to draw."""
    found = [(row["step"], row.get("seconds"), row.get("psnr")) for row in RunLog(run).rows()]
    rows = [row for row in found if None not in row]
    if len(rows) < 2:
        return None
    steps, seconds, psnr = np.array(rows, np.float64).T
    steps += 1
    keep = np.unique(np.linspace(0, len(rows) - 1, POINTS).round().astype(int))
    return Curve(name, steps[keep], seconds[keep], smoothed(psnr, SMOOTHED_SHARE)[keep])


def smoothed(values: Numbers, share: float) -> Numbers:
    """Centerd running mean over a share of all values; the window shrinks at both ends, so that it stays centered."""
    half = int(len(values) * share / 2)
    index = np.arange(len(values))
    reach = np.minimum(half, np.minimum(index, len(values) - 1 - index))
    sums = np.concatenate(([0.0], np.cumsum(values)))
    return np.asarray((sums[index + reach + 1] - sums[index - reach]) / (2 * reach + 1))


def curves_svg(curves: Sequence[Curve], axis: str) -> str:
    """An SVG element with PSNR over ``axis``, "steps" or "seconds"; curve ``i`` has the classes ``curve c<i>``."""
    across = [getattr(curve, axis) for curve in curves]
    x_ticks = ticks(0.0, max(float(x.max()) for x in across))
    y_ticks = ticks(
        min(float(curve.psnr.min()) for curve in curves), max(float(curve.psnr.max()) for curve in curves)
    )
    x_end, y_low, y_high = x_ticks[-1], y_ticks[0], y_ticks[-1]

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            LEFT + (WIDTH - LEFT - RIGHT) * x / x_end,
            HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (y - y_low) / (y_high - y_low),
        )

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="PSNR over {axis}">']
    for tick in y_ticks:
        y = place(0, tick)[1]
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="end" x="{LEFT - 7}" y="{y + 4:.1f}">{tick:g}</text>')
    for tick in x_ticks:
        x = place(tick, y_low)[0]
        bottom = HEIGHT - BOTTOM
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="middle" x="{x:.1f}" y="{bottom + 17}">{tick:,g}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text class="middle label" x="{middle:.1f}" y="{HEIGHT - 6}">{axis}</text>')
    y = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text class="middle label" transform="translate(14 {y:.1f}) rotate(-90)">PSNR (dB), training views</text>'
    )
    for index, (curve, x_values) in enumerate(zip(curves, across, strict=True)):
        points = " ".join(
            "{:.1f},{:.1f}".format(*place(float(x), float(y)))
            for x, y in zip(x_values, curve.psnr, strict=True)
        )
        parts.append(
            f'<polyline class="curve c{index % COLORS}" {dash(index)} data-name="{html.escape(curve.name)}" '
            f'points="{points}"><title>{html.escape(curve.name)}</title></polyline>'
        )
    return "".join([*parts, "</svg>"])


def dash(index: int) -> str:
    """The attribute that tells curve ``index`` from those before it of the same color."""
    pattern = DASHES[index // COLORS % len(DASHES)]
    return f'stroke-dasharray="{pattern}"' if pattern else ""


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers at equal distances that enclose [low, high], roughly as many as asked for."""
    rough = max(high - low, 1e-6) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 10) for index in range(first, max(last, first + 1) + 1)]


def grid(
    place: Callable[[float, float], tuple[float, float]],
    x_ticks: Sequence[float],
    y_ticks: Sequence[float],
    *,
    numbered: bool = True,
) -> list[str]:
    """SVG elements of horizontal lines at ``y_ticks``, and the numbers at both axes.

    Args:
        place: where a point lies in the picture. numbered: whether ``x_ticks`` are printed, too.
    """
    parts = []
    for tick in y_ticks:
        (x1, y), (x2, _) = place(x_ticks[0], tick), place(x_ticks[-1], tick)
        parts.append(f'<line class="grid" x1="{x1:.1f}" x2="{x2:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text text-anchor="end" x="{x1 - 6:.1f}" y="{y + 4:.1f}">{tick:g}</text>')
    for tick in x_ticks if numbered else ():
        x, y = place(tick, y_ticks[0])
        parts.append(f'<text text-anchor="middle" x="{x:.1f}" y="{y + 16:.1f}">{tick:g}</text>')
    return parts
