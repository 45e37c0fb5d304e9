"""The tables of a comparison as people read them, and their files: Markdown, LaTeX, CSV and the record."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from msgspec import UNSET

from polarguide.core.files import write_text
from polarguide.core.text import csv_value, printable
from polarguide.results.evaluation.table import (
    COLUMNS,
    MESH_LABEL,
    METAL_SHARE,
    METRICS,
    PART_METRICS,
    Metric,
)
from polarguide.visualization.pages import templates
from polarguide_bench.results import (
    Cell,
    Results,
    RunRecord,
    ScoreRow,
    Values,
    controlled,
    known,
    metric_of_runs,
    pair,
    scatter_on,
    seed_means,
    told_apart,
    values_of,
)

NOT_APPLICABLE = "n/a"
MEAN_TITLE = "mean over scenes"
OVER_SCENES = "over scenes"
MINUS = "\N{MINUS SIGN}"
_HOW = (
    "Differences are taken at the same seed and test view. Bold: better, beyond noise; ≈: within noise, another seed, "
    "other views or, over scenes, other scenes may turn it; ?: noise not known.",
    "Brackets: 95 % confidence interval by Student's t, over scenes or seeds where these are at least three, else over "
    "test views: that one holds for these trainings only, and what is noise is judged by the known scatter, too.",
)
_HOW_PARTS = (
    "Scores on the pixels of a part, means over seeds. Bold: as above, but no scatter is known of parts, so that with "
    "fewer than three paired seeds nothing is bold."
)
_HOW_BOLD = (
    "Bold: the best of each scene and column, and whatever the paired test cannot tell from it, with 95 % confidence: "
    "by the differences at the same seeds where three are paired, else by the known scatter of such differences. "
    "Where the test tells nothing apart, nothing is bold."
)


TableCell = tuple[str, str, bool]
"""A value, what stands after it (spread, interval; empty: nothing), and whether it is bold."""
Label = tuple[str, bool, str]
"""What a row is called: a name, whether it is one of code (a recipe), and a remark after it (empty: none)."""
TableRow = tuple[list[Label], list[TableCell]]
"""As many labels as its section has, and as many cells as that has headings."""
EMPTY: TableCell = ("", "", False)


class Section(NamedTuple):
    """Blocks with the same columns.

    Attributes:
        key: name for links. title: heading; empty for the scores, which come first.
        labels: headings of the labels. headings: those of the cells. blocks: titles and their rows.
        notes: what a reader has to know, a sentence each.
    """

    key: str
    title: str
    labels: tuple[str, ...]
    headings: list[str]
    blocks: list[tuple[str, list[TableRow]]]
    notes: list[str]


def formatted(value: float | None, column: Metric) -> str:
    """A recorded value as tables show it, without its unit; empty for None."""
    return "" if value is None else f"{value * column.factor:,.{column.digits}f}"


def signed(value: float, column: Metric) -> str:
    """A difference of recorded values as tables show it, with a true minus sign and never a negative zero."""
    text = f"{round(value * column.factor, column.digits) + 0.0:+,.{column.digits}f}"
    return text.replace("-", MINUS)


def sections(results: Results) -> list[Section]:
    """All tables of a comparison, in the order in which they are shown; only those that have rows."""
    tables = (
        scores_section(results),
        control_section(results),
        against_section(results),
        part_section(results, "object"),
        part_section(results, "material"),
    )
    return [section for section in tables if section.blocks]


def scores_section(results: Results) -> Section:
    """The scores by scene, of every metric with a value, with the leaders of every column marked."""
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
            bold[column.key] = leaders(means, of, column, scatter_on(results.record, of, column))
        parts = [
            (
                [(row.recipe, True, _remark(row, results))],
                [score_cell(row, column, index in bold[column.key], results) for column in columns],
            )
            for index, row in enumerate(rows)
        ]
        blocks.append((scene or MEAN_TITLE, parts))
    return Section("scores", "", ("recipe",), [c.heading for c in columns], blocks, notes(results))


def leaders(
    means: Mapping[int, float], values: Values, column: Metric, scatter: Sequence[float | None]
) -> set[int]:
    """The recipes whose mean of a metric is the best, or cannot be told from the best.

    A recipe is told from the best by the differences at the same seeds, if they exceed ``training_noise``. There are no
    leaders where that tells no recipe from the best, or the metric has no better side.

    Args:
        means: shown values, by the place of the recipe. values: what these are means of.
        column: the metric. scatter: the known scatter on each scene of the values.
    """
    if column.better is None or len(means) < 2:
        return set()
    sign = 1.0 if column.better == "higher" else -1.0
    best = max(means, key=lambda index: sign * means[index])
    apart = {index: told_apart(values, best, index, sign, scatter) for index in means if index != best}
    if True not in apart.values():
        return set()
    same_digits = {
        i for i, mean in means.items() if formatted(mean, column) == formatted(means[best], column)
    }
    return same_digits | {index for index, told in apart.items() if told is False}


def score_cell(row: ScoreRow, column: Metric, bold: bool, results: Results) -> TableCell:
    """The cell of a recipe's score on a scene."""
    cell: Cell = row.cells[column.key]
    if cell.mean is None:
        # A speed that was not measured alone, or a run that has not finished, is not "not applicable".
        others = (r.cells[column.key].count for r in results.table if r.recipe == row.recipe)
        empty = column.timed or not row.finished or (row.scene is None and any(others))
        return "" if empty else NOT_APPLICABLE, "", False
    spread = "" if cell.spread is None else f"± {formatted(cell.spread, column)}"
    return formatted(cell.mean, column), spread, bold


def seed_counts(results: Results) -> list[int]:
    """The requested number of seeds: one number, or several where recipes or scenes differ in it; ascending."""
    return sorted(set(Counter((run.scene, run.recipe) for run in results.record.runs).values()))


def _remark(row: ScoreRow, results: Results) -> str:
    """Its number of steps where that is not the others', and what is missing of it, else its seeds if rows differ."""
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
    """Notes that a reader of the scores needs, a sentence each."""
    counts = seed_counts(results)
    record = results.record
    number = f"{counts[0]} " if len(counts) == 1 else ""
    stated = {
        "↑ higher is better, ↓ lower is better.": True,
        _HOW_BOLD: True,
        "The number of seeds differs between rows: it stands after the name.": len(counts) > 1,
        f"Mean ± sample standard deviation over {number}seeds.": max(counts) > 1,
        "Of one seed, what another would change is not in the table.": min(counts) < 2,
        "Mean over scenes: over those where any recipe has a value of the column, with one weight each.": len(
            record.scenes
        )
        > 1,
    }
    sentences = [text for text, holds in stated.items() if holds]
    sentences += [f"{scene.name}: {text}" for scene in record.scenes for text in scene.warnings or ()]
    finished = [run for run in record.runs if run.state == "done"]
    for label, field in (("LPIPS", "lpips_reason"), (MESH_LABEL, "mesh_reason")):
        reasons = dict.fromkeys(getattr(run, field) for run in finished)
        sentences += [f"{label} {NOT_APPLICABLE}: {reason}." for reason in reasons if reason]
    for run in record.runs:
        if run.state != "done":
            what = "failed" if run.state == "failed" else "has not finished"
            sentences.append(
                f"{run.scene}, {run.recipe}, seed {run.seed} {what}" + (f": {run.error}" if run.error else "")
            )
    return sentences


def control_section(results: Results) -> Section:
    """The gain by polarization: a block for every recipe with controls, a row for every scene and one over scenes."""
    compared = [d for d in results.compared if d["why"] == "control"]
    columns = _columns(compared)
    blocks = []
    stated = []
    for recipe, controls in controlled(results.recipes).items():
        letters = dict(zip(controls, "abcdefghij", strict=False)) if len(controls) > 1 else {}
        names = ", ".join(f"{letters[c]}: {c}" if letters else c for c in controls)
        mine = [d for d in compared if d["recipe"] == recipe]
        rows = [
            _row(s, False, [d for d in mine if d["scene"] == s], columns, letters) for s in _places(results)
        ]
        blocks.append((recipe, rows))
        stated.append(
            f"{recipe}: the difference to the better of its controls, metric by metric ({names})."
            if letters
            else f"{recipe}: the difference to its control, {names}."
        )
    stated += dict.fromkeys(
        f"{d['scene'] or OVER_SCENES}, {d['recipe']}: chosen without {', '.join(d['left_out'])}, for want of "
        "runs to pair."
        for d in compared
        if d["left_out"]
    )
    headings = [column.heading for column in columns]
    labels = ("scene", "interval over")
    return Section("controls", "What polarization buys", labels, headings, blocks, [*stated, *_HOW])


def against_section(results: Results) -> Section:
    """Differences to a chosen recipe: a block for every scene, a row for every other recipe."""
    against = results.record.settings.against
    compared = [d for d in results.compared if d["why"] == "against"]
    columns = _columns(compared)
    blocks = []
    for scene in _places(results) if against is not None else []:
        mine = [d for d in compared if d["scene"] == scene]
        rows = [
            _row(recipe, True, [d for d in mine if d["recipe"] == recipe], columns, {})
            for recipe in results.recipes
            if recipe != against
        ]
        blocks.append((scene or OVER_SCENES, rows))
    headings = [column.heading for column in columns]
    title = f"Differences to {against}"
    return Section("against", title, ("recipe", "interval over"), headings, blocks, [*_HOW])


def _places(results: Results) -> list[str | None]:
    return [*results.scenes, None] if len(results.scenes) > 1 else [*results.scenes]


def _columns(compared: Sequence[Mapping[str, Any]]) -> list[Metric]:
    there = {difference["metric"] for difference in compared}
    return [column for column in COLUMNS if column.shown == "tables" and column.key in there]


def _row(
    name: str | None,
    code: bool,
    compared: Sequence[Mapping[str, Any]],
    columns: Sequence[Metric],
    letters: Mapping[str, str],
) -> TableRow:
    """The differences of one row; the unit of most of its intervals stands once, other units in their cells."""
    by_key = {difference["metric"]: difference for difference in compared}
    units = [_unit(by_key[column.key]) for column in columns if column.key in by_key]
    usual = max(dict.fromkeys(units), key=units.count, default="")
    cells = []
    for column in columns:
        of = by_key.get(column.key)
        if of is None:
            cells.append(EMPTY)
            continue
        unit = _unit(of)
        letter = letters.get(of["other"], "")
        interval = "" if of["low"] is None else f"[{signed(of['low'], column)}, {signed(of['high'], column)}]"
        more = " ".join(filter(None, (interval, "" if unit == usual else f"({unit})", letter)))
        cells.append(_gain(of["mean"], of["noise"], column, more))
    remark = "" if compared else "no runs to pair"
    return [(name or OVER_SCENES, code, remark), (usual, False, "")], cells


def _unit(difference: Mapping[str, Any]) -> str:
    """The unit of the interval; without an interval, the number of seeds."""
    seeds = f"{difference['seeds']} seed{'' if difference['seeds'] == 1 else 's'}"
    if difference["over"] is None:
        return f"none, {seeds}"
    return f"{difference['count']} {difference['over']}" + (
        f" of {seeds}" if difference["over"] == "views" else ""
    )


def _gain(value: float, noise: bool | None, column: Metric, more: str = "") -> TableCell:
    """A difference with the mark of its noise: ≈ within it, ? not known; bold: better beyond it."""
    text = ("≈ " if noise else "") + signed(value, column) + ("?" if noise is None else "")
    return text, more, noise is False and (value > 0) == (column.better == "higher")


def part_section(results: Results, kind: str) -> Section:
    """Where the error is: a block for every metric, a row for every object of every scene, or for every material."""
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
                cells = [*_means(values, column), *_gains(results, values, with_controls, column)]
                names = labels if kind == "object" else (*labels, ", ".join(scenes))
                rows.append(([(name, False, "") for name in names], cells))
        if rows:
            blocks.append((column.heading, rows))
    parts = [_HOW_PARTS]
    if with_controls:
        parts.append(
            "The last columns: what polarization buys, the difference to the better control; bold and ≈ as above."
        )
    if kind == "material":
        parts.append("Means over the scenes that have the material, with one weight each.")
    headings = [*results.recipes, *(f"{recipe} {MINUS} control" for recipe in with_controls)]
    titles = ("scene", "object", "material") if kind == "object" else ("material", "scenes")
    return Section(f"{kind}s", f"By {kind}", titles, headings, blocks, parts)


def _part_score(kind: str, labels: Sequence[str], key: str, run: RunRecord) -> dict[str, float | None]:
    """For ``values_of``: a metric of an object (scene, name, material), or of a material (name)."""
    part = run.objects.get(labels[1]) if kind == "object" else run.materials.get(labels[0])
    if part is None or (kind == "object" and (part.material or "") != labels[2]):
        return {}
    return {"": part.metrics.get(key)}


def _means(values: Values, column: Metric) -> Iterator[TableCell]:
    """A cell for every recipe; empty where it lacks a scene that another has."""
    recipes = np.transpose([seed_means(v) for v in values.values()], (1, 0, 2))  # [recipes, scenes, seeds]
    means = {
        index: fmean(fmean(known(seeds)) for seeds in of)
        for index, of in enumerate(recipes)
        if all(known(seeds) for seeds in of)
    }
    bold = leaders(means, values, column, [None] * len(values))
    for index in range(len(recipes)):
        empty = index not in means
        yield EMPTY if empty else (formatted(means[index], column), "", index in bold)


def _gains(
    results: Results, values: Values, recipes: Mapping[str, Sequence[str]], column: Metric
) -> Iterator[TableCell]:
    """The gain by polarization of every recipe with controls."""
    for recipe, controls in recipes.items():
        gain = None
        if column.better is not None:
            gain = pair(results.record, values, recipe, controls, column, scatter=False)
        yield EMPTY if gain is None else _gain(gain["mean"], gain["noise"], column)


_LATEX = {
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
_MARKDOWN = {character: "\\" + character for character in "\\`*_[]<>#"}
_TEXTS = templates("polarguide_bench").overlay(
    # Braces are LaTeX's.
    variable_start_string="<<", variable_end_string=">>", block_start_string="<%", block_end_string="%>",
)  # fmt: skip


def markdown_text(text: str) -> str:
    """Text on one line that Markdown leaves alone."""
    return "".join(_MARKDOWN.get(character, character) for character in printable(" ".join(text.split())))


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX reads as a command."""
    return "".join(_LATEX.get(character, character) for character in printable(" ".join(text.splitlines())))


_TEXTS.filters.update(md=markdown_text, tex=latex_text, printable=printable)


def write_tables(out: Path, results: Results) -> None:
    """Write ``results.json``, ``.md``, ``.csv`` and ``.tex``, each in one step, and what else there is as CSV."""
    write_text(out / "results.json", json.dumps(results.content(), indent=1, allow_nan=False) + "\n")
    tables = sections(results)
    for name in ("results.md", "results.tex"):
        write_text(out / name, readable(tables, name))
    for name, frame in (
        ("results.csv", results.scores),
        ("differences.csv", results.differences),
        ("parts.csv", results.parts),
    ):
        if frame.empty:
            (out / name).unlink(missing_ok=True)  # of a comparison with other recipes
        else:
            write_text(out / name, csv_text(frame))


def readable(tables: Sequence[Section], name: str) -> str:
    """Tables with their notes, as ``results.md`` or ``results.tex``."""
    return _TEXTS.get_template(name).render(sections=tables)


def csv_text(frame: pd.DataFrame) -> str:
    """A frame in full precision, with the numbers that pages show; nothing in it is a formula to a spreadsheet.

    Metrics have the unit of tables where records have another, and keys that end with it: ``haze_percent``.

    Args:
        frame: metrics are columns by their keys, with their ``_spread``; or lines, of which ``metric`` has the key.
    """
    frame = frame.copy()
    names = {}
    for metric in (*METRICS, METAL_SHARE):
        if metric.factor == 1:
            continue
        shown = f"{metric.key}_{'percent' if metric.unit == '%' else metric.unit}"
        for suffix in ("", "_spread"):
            names[metric.key + suffix] = shown + suffix
            if metric.key + suffix in frame:
                frame[metric.key + suffix] = frame[metric.key + suffix].astype(float) * metric.factor
        if "metric" in frame:
            frame.loc[frame["metric"] == metric.key, ["mean", "low", "high"]] *= metric.factor
    if "metric" in frame:
        frame["metric"] = frame["metric"].replace(names)
    return frame.rename(columns=names).map(csv_value).to_csv(index=False, lineterminator="\n")
