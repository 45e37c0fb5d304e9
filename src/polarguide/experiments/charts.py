"""Charts of a comparison as SVG: training curves, scores over a number under study, and over the pictures taken."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polarguide.experiments.results import Results
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide.runs.folder import RunLog
from polarguide.visualization.pages import BASE, templates

Numbers = NDArray[np.float64]
POINTS = 240
SMOOTHED_SHARE = 0.05
"""Share of a training over which a curve is averaged: single steps show single views, which differ by decibels."""
DASHES = ("none", "7 4", "2 3")
"""There are eight colors: further curves repeat them dashed, then dotted."""
STUDIED = ("psnr", "normal_mae_deg")
NAMES = {
    "views": "training views",
    "noise": "noise (1: exposed to full scale, 2: a quarter of that light)",
    "index": "refractive index",
    "spacing": "degrees between neighboring views",
}
"""What the parameters of a sweep are called at the axis, where their name does not say it."""
OVER_PICTURES = ("psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
APART = 0.12
"""Between the points of two scenes in one column, of its width."""


class Series(NamedTuple):
    """Points of one color: x, y, and the text under the pointer, empty for points that are not drawn."""

    name: str
    points: list[tuple[float, float, str]]


class Panel(NamedTuple):
    """One pair of axes: the places with words at the x axis and its ends, numbers at the y axis."""

    title: str
    axis: str
    series: list[Series]
    x_ticks: list[tuple[float, list[str]]]
    x_ends: tuple[float, float]
    y_ticks: list[float]


def panel(title: str, axis: str, series: list[Series], columns: Sequence[list[str]] = ()) -> Panel:
    """A panel that holds all its points.

    Args:
        columns: words at the places 0, 1, ... of the x axis; without any, it has round numbers.
    """
    points = [point for of in series for point in of.points]
    first, last = min(x for x, _, _ in points), max(x for x, _, _ in points)
    numbers = ticks(first if first > last / 2 else 0.0, last)
    x_ticks = [(float(place), words) for place, words in enumerate(columns)] or [
        (number, [f"{number:,g}"]) for number in numbers
    ]
    x_ends = (-0.5, len(columns) - 0.5) if columns else (numbers[0], numbers[-1])
    return Panel(
        title, axis, series, x_ticks, x_ends, ticks(min(p[1] for p in points), max(p[1] for p in points))
    )


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers at equal distances that enclose [low, high], roughly as many as asked for."""
    rough = max(high - low, 1e-6) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 10) for index in range(first, max(last, first + 1) + 1)]


def chart(panels: Sequence[Panel], legend: Sequence[str], *, lines: bool = True) -> str:
    """An SVG file, its colors in the order of the legend."""
    size = {"width": 430, "height": 330}
    return _svg(panels=panels, legend=legend, lines=lines, label="scores", **size)


def _svg(**values: object) -> str:
    return templates(BASE).get_template("chart.svg").render(dashes=DASHES, **values)


class Curve(NamedTuple):
    """PSNR in dB [P] over step and seconds [P] of one run, smoothed."""

    name: str
    steps: Numbers
    seconds: Numbers
    psnr: Numbers


def read_curve(run: Path, name: str) -> Curve | None:
    """The curve of a run by its log, at most ``POINTS`` points; None where there is no line to draw."""
    measured = [(row["step"], row.get("seconds"), row.get("psnr")) for row in RunLog(run).rows()]
    rows = [row for row in measured if None not in row]
    if len(rows) < 2:
        return None
    steps, seconds, psnr = np.array(rows, np.float64).T
    keep = np.unique(np.linspace(0, len(rows) - 1, POINTS).round().astype(int))
    return Curve(name, steps[keep] + 1, seconds[keep], smoothed(psnr, SMOOTHED_SHARE)[keep])


def smoothed(values: Numbers, share: float) -> Numbers:
    """Centered running mean over a share of all values; the window shrinks at both ends, so that it stays centered."""
    half = int(len(values) * share / 2)
    index = np.arange(len(values))
    reach = np.minimum(half, np.minimum(index, len(values) - 1 - index))
    sums = np.concatenate(([0.0], np.cumsum(values)))
    return np.asarray((sums[index + reach + 1] - sums[index - reach]) / (2 * reach + 1))


def curves_svg(curves: Sequence[Curve], axis: str) -> str:
    """An SVG element with PSNR over ``axis``, "steps" or "seconds", in the colors of the page that it is put into."""
    series = [
        Series(c.name, [(x, y, "") for x, y in zip(getattr(c, axis), c.psnr, strict=True)]) for c in curves
    ]
    panels = [panel("PSNR (dB), training views", axis, series)]
    return _svg(panels=panels, legend=(), lines=True, label=f"PSNR over {axis}", width=860, height=340)


def read_study(scene: Path) -> tuple[str, float] | None:
    """The number under study that ``scene.json`` names, as (parameter, value), or None."""
    try:
        study = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["study"]
        return str(study["parameter"]), float(study["value"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def study_svg(results: Results, studies: Mapping[str, tuple[str, float] | None]) -> str | None:
    """Every recipe's scores over the number under study.

    Args:
        studies: by scene, what ``read_study`` found.

    Returns:
        None where the scenes are no family of ``polarguide synth --sweep``: fewer than two values, or different
        parameters.
    """
    values = {scene: study[1] for scene, study in studies.items() if study is not None}
    parameters = {study and study[0] for study in studies.values()}
    if len(values) < len(studies) or len(parameters) != 1 or len(set(values.values())) < 2:
        return None
    name = str(parameters.pop())
    panels = []
    for metric in _metrics(STUDIED):
        series = [Series(recipe, []) for recipe in results.recipes]
        for scene, recipe, mean in _scores(results, metric):
            text = f"{recipe}, {name} {values[scene]:g}: {mean:.2f}"
            series[results.recipes.index(recipe)].points.append((values[scene], mean, text))
        if any(of.points for of in series):
            series = [Series(of.name, sorted(of.points)) for of in series]
            panels.append(panel(metric.heading, NAMES.get(name, name), series))
    return chart(panels, results.recipes) if panels else None


def exposure_svg(results: Results, pictures: Mapping[tuple[str, str], int]) -> str | None:
    """The scores of all rows of the tables, a panel for each metric, a column for each row, a color for each scene.

    Rows come in the order of the pictures they took, and of the tables where these are as many.

    Args:
        pictures: by scene and row, how many were taken.

    Returns:
        None where there is nothing to draw.
    """
    numbers = {row: [pictures[scene, row] for scene in results.scenes] for row in results.recipes}
    rows = sorted(numbers, key=lambda row: max(numbers[row]))
    columns = [[row, " to ".join(map(str, sorted({min(numbers[row]), max(numbers[row])})))] for row in rows]
    panels = []
    for metric in _metrics(OVER_PICTURES):
        series = [Series(scene, []) for scene in results.scenes]
        for scene, row, mean in _scores(results, metric):
            place = results.scenes.index(scene)
            x = rows.index(row) + (place - (len(series) - 1) / 2) * min(APART, 1 / (len(series) + 1))
            text = f"{scene}, {row}, {pictures[scene, row]} pictures: {mean:.2f}"
            series[place].points.append((x, mean, text))
        if any(of.points for of in series):
            panels.append(panel(metric.heading, "training pictures", series, columns))
    return chart(panels, results.scenes, lines=False) if panels else None


def _metrics(keys: Sequence[str]) -> list[Metric]:
    return [metric for key in keys for metric in COLUMNS if metric.key == key]


def _scores(results: Results, metric: Metric) -> list[tuple[str, str, float]]:
    """Scene, recipe and mean, where there is one."""
    table = results.scores.dropna(subset=["scene", metric.key])
    return list(zip(table["scene"], table["recipe"], table[metric.key], strict=True))
