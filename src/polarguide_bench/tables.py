"""Tables of a comparison, and their output as Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from msgspec import UNSET

from polarguide.core.files import write_text
from polarguide.core.text import csv_value, printable
from polarguide.results.evaluation.table import (
    COLUMNS,
    MESH_LABEL,
    METRICS,
    PART_METRICS,
    PART_SHARES,
    Metric,
)
from polarguide.visualization.pages import templates
from polarguide_bench.results import (
    KNOWN_SCATTER,
    Results,
    RunRecord,
    ScoreRow,
    Values,
    controlled,
    known,
    metric_of_runs,
    pair,
    seed_means,
    told_apart,
    values_of,
)

BY_KEY = {metric.key: metric for metric in COLUMNS}
"""Built-in metrics and those of plug-ins, by key."""
NOT_APPLICABLE = "n/a"
OVER_SCENES = "over scenes"
MINUS = "\N{MINUS SIGN}"
_DIFFERENCE_NOTES = (
    "Differences are taken at the same seed and test view. Bold: better beyond noise. ≈: within noise. Another seed, "
    "other views or, over scenes, other scenes may change the sign. ?: unknown noise.",
    "Brackets: 95 % confidence interval by Student's t. It is over scenes or seeds if there are at least three, and "
    "otherwise over test views. An interval over test views holds for these trainings only, so noise is also judged by "
    "the known scatter.",
)
_PART_NOTE = (
    "Scores on the pixels of a part, means over seeds. Bold: as above. The scatter of parts is unknown, so nothing is "
    "bold with fewer than three paired seeds."
)
_BOLD_NOTE = (
    "Bold: the best of each scene and column, and all that the paired test cannot distinguish from it, with 95 % "
    "confidence. The test uses the differences at the same seeds if there are three pairs, and otherwise the known "
    "scatter of such differences. Nothing is bold if the test distinguishes nothing."
)


TableCell = tuple[str, str, bool]
"""Cell of a table: a value, its spread or interval (may be empty), and True for bold type."""
Label = tuple[str, bool, str]
"""Label of a row: a name, True if the name is set as code (a recipe), and a remark (may be empty)."""
TableRow = tuple[list[Label], list[TableCell]]
"""Row of a table: its labels and its cells, one for each column of the section."""
EMPTY: TableCell = ("", "", False)


class Section(NamedTuple):
    """Table with one or several blocks of rows that have the same columns.

    Attributes:
        key: name of the section in links.
        title: heading. It is empty for the scores, which are the first section.
        labels: headings of the columns with labels.
        headings: headings of the columns with values.
        blocks: title and rows of each block.
        notes: sentences that explain the table.
    """

    key: str
    title: str
    labels: tuple[str, ...]
    headings: list[str]
    blocks: list[tuple[str, list[TableRow]]]
    notes: list[str]


def formatted(value: float | None, column: Metric) -> str:
    """Format a recorded value for a table, without its unit. None becomes an empty text."""
    return "" if value is None else f"{value * column.factor:,.{column.digits}f}"


def signed(value: float, column: Metric) -> str:
    """Format a difference with a plus or minus sign. Zero has no minus sign."""
    text = f"{round(value * column.factor, column.digits) + 0.0:+,.{column.digits}f}"
    return text.replace("-", MINUS)


def sections(results: Results) -> list[Section]:
    """Return all tables of a comparison that have rows, in the order of display."""
    tables = (
        scores_section(results),
        control_section(results),
        against_section(results),
        part_section(results, "object"),
        part_section(results, "material"),
    )
    return [section for section in tables if section.blocks]


def scores_section(results: Results) -> Section:
    """Return the table of scores by scene for all metrics with values. Leading values of each column are bold."""
    columns = [
        c for c in COLUMNS if c.shown == "tables" and any(row.cells[c.key].count for row in results.table)
    ]
    values = {column.key: values_of(results.record, metric_of_runs(column.key)) for column in columns}
    blocks = []
    for scene in dict.fromkeys(row.scene for row in results.table):
        rows = [row for row in results.table if row.scene == scene]
        bold = {}
        for column in columns:
            means = {i: m for i, row in enumerate(rows) if (m := row.cells[column.key].mean) is not None}
            of = {s: v for s, v in values[column.key].items() if scene in (None, s)}
            bold[column.key] = leaders(means, of, column, KNOWN_SCATTER.get(column.key))
        parts = [
            (
                [(row.recipe, True, _remark(row, results))],
                [score_cell(row, column, index in bold[column.key], results) for column in columns],
            )
            for index, row in enumerate(rows)
        ]
        blocks.append((scene or "mean over scenes", parts))
    return Section("scores", "", ("recipe",), [c.heading for c in columns], blocks, notes(results))


def leaders(means: Mapping[int, float], values: Values, column: Metric, scatter: float | None) -> set[int]:
    """Return the recipes with the best mean of a metric, and all recipes that are not significantly worse.

    The test compares differences at the same seeds with ``training_noise``. The set is empty if no recipe is
    significantly worse than the best, or if the metric has no better direction.

    Args:
        means: displayed values by index of the recipe.
        values: values of all runs.
        column: the metric.
        scatter: known scatter of these values, or None.
    """
    if column.better is None or len(means) < 2:
        return set()
    sign = 1.0 if column.better == "higher" else -1.0
    best = max(means, key=lambda index: sign * means[index])
    apart = {index: told_apart(values, best, index, column, scatter) for index in means if index != best}
    if True not in apart.values():
        return set()
    digits = formatted(means[best], column)
    return {i for i, mean in means.items() if apart.get(i) is False or formatted(mean, column) == digits}


def score_cell(row: ScoreRow, column: Metric, bold: bool, results: Results) -> TableCell:
    """Format the score of a recipe on a scene as a cell."""
    cell = row.cells[column.key]
    if cell.mean is None:
        # A speed without its own measurement, or an unfinished run, is not "not applicable".
        others = (r.cells[column.key].count for r in results.table if r.recipe == row.recipe)
        empty = column.timed or not row.finished or (row.scene is None and any(others))
        return "" if empty else NOT_APPLICABLE, "", False
    spread = "" if cell.spread is None else f"± {formatted(cell.spread, column)}"
    return formatted(cell.mean, column), spread, bold


def seed_counts(results: Results) -> list[int]:
    """Return all numbers of seeds that occur for recipes and scenes, without repetition and in ascending order."""
    return sorted(set(Counter((run.scene, run.recipe) for run in results.record.runs).values()))


def _remark(row: ScoreRow, results: Results) -> str:
    """Return the remark of a row: a different number of steps, missing runs, or a different number of seeds."""
    (steps,) = (recipe.steps for recipe in results.record.recipes if recipe.name == row.recipe)
    states = [r.state for r in results.record.runs if r.recipe == row.recipe and row.scene in (None, r.scene)]
    finished = states.count("done")
    missing = ""
    if states and not finished:
        missing = "failed" if "failed" in states else "missing"
    elif finished < len(states):
        missing = f"{finished} of {len(states)} {'runs' if row.scene is None else 'seeds'}"
    elif row.scene is not None and len(seed_counts(results)) > 1:
        missing = f"{finished} seed{'' if finished == 1 else 's'}"
    return ", ".join(filter(None, (f"{steps:,} steps" if steps is not UNSET else "", missing)))


def notes(results: Results) -> list[str]:
    """Return sentences that explain the scores."""
    counts = seed_counts(results)
    record = results.record
    number = f"{counts[0]} " if len(counts) == 1 else ""
    conditions = {
        "↑ higher is better, ↓ lower is better.": True,
        _BOLD_NOTE: True,
        "The number of seeds differs between rows. It follows the name.": len(counts) > 1,
        f"Mean ± sample standard deviation over {number}seeds.": max(counts) > 1,
        "One seed does not show how much another seed would change.": min(counts) < 2,
        "Mean over scenes: each scene on which any recipe has a value of the column has the same weight.": len(
            record.scenes
        )
        > 1,
    }
    sentences = [text for text, holds in conditions.items() if holds]
    sentences += [f"{scene.name}: {text}" for scene in record.scenes for text in scene.warnings or ()]
    for label, field in (("LPIPS", "lpips_reason"), (MESH_LABEL, "mesh_reason")):
        reasons = dict.fromkeys(getattr(run, field) for run in record.runs if run.state == "done")
        sentences += [f"{label} {NOT_APPLICABLE}: {reason}." for reason in reasons if reason]
    for run in record.runs:
        if run.state != "done":
            state = "failed" if run.state == "failed" else "has not finished"
            error = f": {run.error}" if run.error else ""
            sentences.append(f"{run.scene}, {run.recipe}, seed {run.seed} {state}{error}")
    return sentences


def control_section(results: Results) -> Section:
    """Return the table of gains by polarization: differences between recipes and their controls.

    It has a block for each recipe with controls, and a row for each scene and for the mean over scenes.
    """
    compared = [d for d in results.compared if d["why"] == "control"]
    columns = _columns(compared)
    blocks = []
    stated = []
    for recipe, controls in controlled(results.recipes).items():
        letters = dict(zip(controls, "abcdefghij", strict=False)) if len(controls) > 1 else {}
        names = ", ".join(f"{letters[c]}: {c}" if letters else c for c in controls)
        rows = [
            _row(scene, False, [d for d in compared if (d["recipe"], d["scene"]) == (recipe, scene)], columns, letters)
            for scene in _places(results)
        ]  # fmt: skip
        blocks.append((recipe, rows))
        stated.append(
            f"{recipe}: the difference to the better of its controls, metric by metric ({names})."
            if letters
            else f"{recipe}: the difference to its control, {names}."
        )
    stated += dict.fromkeys(
        f"{d['scene'] or OVER_SCENES}, {d['recipe']}: chosen without {', '.join(d['left_out'])}, which has no runs to "
        "pair."
        for d in compared
        if d["left_out"]
    )
    return Section(
        "controls",
        "Gain by polarization",
        ("scene", "interval over"),
        [column.heading for column in columns],
        blocks,
        [*stated, *_DIFFERENCE_NOTES],
    )


def against_section(results: Results) -> Section:
    """Return the table of differences to a reference recipe, with a block per scene and a row per other recipe."""
    against = results.record.settings.against
    compared = [d for d in results.compared if d["why"] == "against"]
    columns = _columns(compared)
    blocks = []
    for scene in _places(results) if against is not None else []:
        rows = [
            _row(recipe, True, [d for d in compared if (d["recipe"], d["scene"]) == (recipe, scene)], columns, {})
            for recipe in results.recipes
            if recipe != against
        ]  # fmt: skip
        blocks.append((scene or OVER_SCENES, rows))
    return Section(
        "against",
        f"Differences to {against}",
        ("recipe", "interval over"),
        [column.heading for column in columns],
        blocks,
        [*_DIFFERENCE_NOTES],
    )


def _places(results: Results) -> list[str | None]:
    return [*results.scenes, None] if len(results.scenes) > 1 else [*results.scenes]


def _columns(compared: Sequence[Mapping[str, Any]]) -> list[Metric]:
    keys = {difference["metric"] for difference in compared}
    return [column for column in COLUMNS if column.shown == "tables" and column.key in keys]


def _row(
    name: str | None,
    code: bool,
    compared: Sequence[Mapping[str, Any]],
    columns: Sequence[Metric],
    letters: Mapping[str, str],
) -> TableRow:
    """Return a row of differences.

    The label states the unit of most of the intervals. A cell states its unit if it differs.
    """
    by_key = {difference["metric"]: difference for difference in compared}
    units = {key: _unit(difference) for key, difference in by_key.items()}
    shown = [units[column.key] for column in columns if column.key in units]
    usual = max(dict.fromkeys(shown), key=shown.count, default="")
    cells = []
    for column in columns:
        of = by_key.get(column.key)
        more = ""
        if of is not None:
            low = "" if of["low"] is None else f"[{signed(of['low'], column)}, {signed(of['high'], column)}]"
            unit = "" if units[column.key] == usual else f"({units[column.key]})"
            more = " ".join(filter(None, (low, unit, letters.get(of["other"], ""))))
        cells.append(_gain(of, column, more))
    remark = "" if compared else "no runs to pair"
    return [(name or OVER_SCENES, code, remark), (usual, False, "")], cells


def _unit(difference: Mapping[str, Any]) -> str:
    """Return the unit of a difference's interval, or the number of seeds if there is no interval."""
    seeds = f"{difference['seeds']} seed{'' if difference['seeds'] == 1 else 's'}"
    if difference["over"] is None:
        return f"none, {seeds}"
    return f"{difference['count']} {difference['over']}" + (
        f" of {seeds}" if difference["over"] == "views" else ""
    )


def _gain(difference: Mapping[str, Any] | None, column: Metric, more: str = "") -> TableCell:
    """Format a difference as a cell that shows its noise.

    The mark ≈ means that the difference is within noise, and ? that the noise is unknown. Bold type means better beyond
    noise.
    """
    if difference is None:
        return EMPTY
    value = difference["mean"]
    noise = difference["noise"]
    text = ("≈ " if noise else "") + signed(value, column) + ("?" if noise is None else "")
    return text, more, noise is False and (value > 0) == (column.better == "higher")


def part_section(results: Results, kind: str) -> Section:
    """Return the table of scores by object or by material, as ``kind`` selects.

    It has a block for each metric, and a row for each object of each scene, or for each material.
    """
    with_controls = controlled(results.recipes)
    places: dict[tuple[str, ...], dict[str, None]] = {}  # an object or a material -> its scenes
    for scene, run in [(s, run) for s in results.scenes for run in results.record.runs if run.scene == s]:
        for name, part in getattr(run, f"{kind}s").items():
            labels: tuple[str, ...] = (scene, name, part.material or "") if kind == "object" else (name,)
            places.setdefault(labels, {})[scene] = None
    blocks = []
    for column in (metric for metric in PART_METRICS if metric.shown == "tables"):
        rows = []
        for labels, scenes in places.items():
            values = values_of(results.record, partial(_part_score, kind, labels, column.key), scenes)
            if values:
                gains = [
                    pair(results.record, values, recipe, controls, column, scatter=False)
                    if column.better is not None
                    else None
                    for recipe, controls in with_controls.items()
                ]
                cells = [*_means(values, column), *(_gain(gain, column) for gain in gains)]
                names = labels if kind == "object" else (*labels, ", ".join(scenes))
                rows.append(([(name, False, "") for name in names], cells))
        if rows:
            blocks.append((column.heading, rows))
    stated = [_PART_NOTE]
    if with_controls:
        stated.append(
            "The last columns show the gain by polarization, the difference to the better control. Marks: as above."
        )
    if kind == "material":
        stated.append("Means over the scenes that contain the material. All scenes have the same weight.")
    return Section(
        f"{kind}s",
        f"By {kind}",
        ("scene", "object", "material") if kind == "object" else ("material", "scenes"),
        [*results.recipes, *(f"{recipe} {MINUS} control" for recipe in with_controls)],
        blocks,
        stated,
    )


def _part_score(kind: str, labels: Sequence[str], key: str, run: RunRecord) -> dict[str, float | None]:
    """Read a metric of an object or a material from a run, for ``values_of``.

    The labels of an object are scene, name and material. The label of a material is its name.
    """
    part = run.objects.get(labels[1]) if kind == "object" else run.materials.get(labels[0])
    if part is None or (kind == "object" and (part.material or "") != labels[2]):
        return {}
    return {"": part.metrics.get(key)}


def _means(values: Values, column: Metric) -> list[TableCell]:
    """Return the mean of each recipe as a cell. It is empty if the recipe lacks a scene that another recipe has."""
    recipes = np.transpose([seed_means(v) for v in values.values()], (1, 0, 2))  # [recipes, scenes, seeds]
    means = {
        index: fmean(fmean(known(seeds)) for seeds in of)
        for index, of in enumerate(recipes)
        if all(known(seeds) for seeds in of)
    }
    bold = leaders(means, values, column, None)
    return [(formatted(means.get(index), column), "", index in bold) for index in range(len(recipes))]


_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "±": r"$\pm$",
        "≈": r"$\approx$",
        MINUS: "$-$",
        **{character: "\\" + character for character in "&%$#_{}"},
    }
)
_MARKDOWN = str.maketrans({character: "\\" + character for character in "\\`*_[]<>#"})
_TEXTS = templates("polarguide_bench").overlay(
    # LaTeX uses braces itself.
    variable_start_string="<<", variable_end_string=">>", block_start_string="<%", block_end_string="%>",
)  # fmt: skip


def markdown_text(text: str) -> str:
    """Escape a text for Markdown, and join its lines."""
    return printable(" ".join(text.split())).translate(_MARKDOWN)


def latex_text(text: str) -> str:
    """Escape a text for LaTeX, and join its lines."""
    return printable(" ".join(text.splitlines())).translate(_LATEX)


_TEXTS.filters.update(md=markdown_text, tex=latex_text, printable=printable)


def write_tables(out: Path, results: Results) -> None:
    """Write ``results.json``, ``.md``, ``.csv`` and ``.tex``, and CSV files of differences and of scores by part."""
    content = {
        **msgspec.to_builtins(results.record),
        "table": [msgspec.to_builtins(row._asdict()) for row in results.table],
        "differences": msgspec.to_builtins(results.compared),
    }
    write_text(out / "results.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    tables = sections(results)
    for name in ("results.md", "results.tex"):
        write_text(out / name, readable(tables, name))
    for name, frame in (
        ("results.csv", results.scores),
        ("differences.csv", results.differences),
        ("parts.csv", results.parts),
    ):
        if frame.empty:
            (out / name).unlink(missing_ok=True)  # from a comparison of other recipes
        else:
            write_text(out / name, csv_text(frame))


def readable(tables: Sequence[Section], name: str) -> str:
    """Return tables with their notes as text, in the format of the file ``name``: ``results.md`` or ``results.tex``."""
    return _TEXTS.get_template(name).render(sections=tables)


def csv_text(frame: pd.DataFrame) -> str:
    """Convert a data frame to CSV in full precision, in the units of the tables, and without formulas.

    If the unit of a metric differs from its recorded unit, the name of the column contains the unit, such as
    ``haze_percent``.

    Args:
        frame: data frame. Either its columns are metrics and their ``_spread``, or the column ``metric`` names the
            metric of each row.
    """
    frame = frame.copy()
    names = {}
    for metric in (metric for metric in (*METRICS, *PART_SHARES) if metric.factor != 1):
        unit = "percent" if metric.unit == "%" else metric.unit
        for suffix in ("", "_spread"):
            key = metric.key + suffix
            names[key] = f"{metric.key}_{unit}{suffix}"
            if key in frame:
                frame[key] = frame[key].astype(float) * metric.factor
        if "metric" in frame:
            frame.loc[frame["metric"] == metric.key, ["mean", "low", "high"]] *= metric.factor
    if "metric" in frame:
        frame["metric"] = frame["metric"].replace(names)
    return frame.rename(columns=names).map(csv_value).to_csv(index=False, lineterminator="\n")
