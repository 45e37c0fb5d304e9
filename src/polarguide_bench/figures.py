"""Figures of a comparison for publications, as PDF and SVG: the scores of all runs by recipe."""

from __future__ import annotations

import io
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from polarguide.core.files import write_whole
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide_bench.results import Results

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Colors of the scenes, which color-blind readers can distinguish."""
PANELS = 3
"""Number of panels in a row."""
WIDTH_INCHES = 7.0
"""Width of a figure, which fits a page with two columns."""
HEIGHT_INCHES = 2.0
"""Height of a row of panels without the names of the recipes."""
SPREAD = 0.6
"""Share of a recipe's place over which the points of the scenes are spread."""
STYLE: Any = {"font.size": 7, "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "polarguide"}
"""Small fonts, text that stays text, and the same file for the same results."""


def write_figures(out: Path, results: Results) -> None:
    """Write ``results.pdf`` and ``results.svg``, with a panel for each metric of the tables.

    Each point is a run with one seed. A bar is the mean over the seeds of a scene. Files of an earlier comparison are
    removed if there are no scores.
    """
    metrics = [
        m
        for m in COLUMNS
        if m.shown == "tables" and m.better is not None and results.runs[m.key].notna().any()
    ]
    files = {kind: out / f"results.{kind}" for kind in ("pdf", "svg")}
    if not metrics:
        for path in files.values():
            path.unlink(missing_ok=True)
        return
    with mpl.rc_context(STYLE):
        figure = draw_scores(results, metrics)
        for kind, path in files.items():
            data = io.BytesIO()
            figure.savefig(data, format=kind, metadata={"CreationDate" if kind == "pdf" else "Date": None})
            write_whole(path, data.getvalue())


def draw_scores(results: Results, metrics: list[Metric]) -> Figure:
    """Draw a panel for each metric, with the recipes at the x axis and a color for each scene."""
    rows = -(-len(metrics) // PANELS)
    names = 0.07 * max(map(len, results.recipes))  # inches of the longest name, which is written upwards
    figure = Figure(figsize=(WIDTH_INCHES, rows * HEIGHT_INCHES + names), layout="constrained")
    grid = figure.subplots(rows, PANELS, squeeze=False).ravel()
    empty = grid.size - len(metrics)
    used = [*grid[: PANELS - empty], *grid[PANELS:]]  # only the first row may be incomplete
    for axes, metric in zip(used, metrics, strict=True):
        _draw_panel(axes, results, metric)
    for axes in used[:-PANELS]:
        axes.set_xticklabels([])  # the last row has the names of the recipes
    for axes in grid[PANELS - empty : PANELS]:
        axes.remove()
    if len(results.scenes) > 1:
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)), frameon=False)
    return figure


def _draw_panel(axes: Axes, results: Results, metric: Metric) -> None:
    width = SPREAD / len(results.scenes)
    for number, scene in enumerate(results.scenes):
        color = COLORS[number % len(COLORS)]
        offset = (number - (len(results.scenes) - 1) / 2) * width
        x: list[float] = []
        y: list[float] = []
        for place, recipe in enumerate(results.recipes):
            rows = results.runs[(results.runs["scene"] == scene) & (results.runs["recipe"] == recipe)]
            values = [metric.factor * value for value in rows[metric.key].dropna()]
            x += [place + offset] * len(values)
            y += values
            if values:
                axes.plot(
                    [place + offset - width / 2.5, place + offset + width / 2.5],
                    [fmean(values)] * 2,
                    color=color,
                )
        axes.plot(x, y, "o", color=color, markersize=3, alpha=0.7, markeredgewidth=0, label=scene)
    axes.set_xticks(range(len(results.recipes)), results.recipes, rotation=90)
    axes.set_xlim(-0.5, len(results.recipes) - 0.5)
    axes.set_title(metric.heading, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", linewidth=0.3)
