"""Figures of a comparison: scores by recipe for publications, and training curves for the report."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from polarguide.core.files import write_whole
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide.runs.folder import RunLog
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
STYLE: Any = {
    "font.size": 7,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "polarguide",
    "text.parse_math": False,
}
"""Small fonts, text that stays text, and the same file for the same results."""
POINTS = 240
"""Approximate number of points of a curve."""
SMOOTHED_SHARE = 0.05
"""Width of the running mean of a curve, as a share of the training. Single steps are noisy, because views differ."""


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
            write_whole(path, _encoded(figure, kind))


def _encoded(figure: Figure, kind: str) -> bytes:
    """Return a figure as a PDF or SVG file without a date."""
    data = io.BytesIO()
    figure.savefig(data, format=kind, metadata={"CreationDate" if kind == "pdf" else "Date": None})
    return data.getvalue()


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


def read_curve(run: Path) -> pd.DataFrame:
    """Read the training curve of a run from its log.

    Returns:
        About ``POINTS`` rows with the columns ``step``, ``seconds``, ``psnr`` (running mean over the training views,
        in dB) and ``held_out`` (mean PSNR of a few held-out views, or NaN).
    """
    log = pd.DataFrame(RunLog(run).rows(), columns=["step", "seconds", "psnr", "held_out"]).astype(float)
    log = log.dropna(subset=["psnr"])
    window = 2 * int(len(log) * SMOOTHED_SHARE / 2) + 1
    log["psnr"] = log["psnr"].rolling(window, center=True, min_periods=1).mean()
    log["step"] += 1
    every = max(1, len(log) // POINTS)
    return log[(np.arange(len(log)) % every == 0) | log["held_out"].notna()]


def training_curves(curves: Mapping[str, pd.DataFrame]) -> str:
    """Draw the PSNR of trainings over steps and over seconds.

    Args:
        curves: result of ``read_curve`` for each recipe. Lines are training views, dots are held-out views.

    Returns:
        An SVG file as a data URI.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_INCHES, 1.3 * HEIGHT_INCHES), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for axes, column, label in zip(panels, ("step", "seconds"), ("steps", "seconds"), strict=True):
            for number, (recipe, curve) in enumerate(curves.items()):
                color = f"C{number % 10}"
                dashes = ("-", "--", ":")[number // 10 % 3]
                axes.plot(curve[column], curve["psnr"], dashes, color=color, linewidth=1, label=recipe)
                axes.plot(curve[column], curve["held_out"], "o", color=color, markersize=3)
            axes.set_xlabel(label)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(linewidth=0.3)
        panels[0].set_ylabel("PSNR (dB)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
        return f"data:image/svg+xml;base64,{base64.b64encode(_encoded(figure, 'svg')).decode()}"
