"""The scores of a comparison by scene, with what cannot be told from the best marked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from polarguide.evaluation.table import COLUMNS, MESH_LABEL, Metric
from polarguide.experiments.aggregate import NO_VALUE, Cell, Row, RunRecord
from polarguide.experiments.intervals import mean
from polarguide.experiments.noise import known_scatter, training_noise
from polarguide.experiments.results import Results
from polarguide.experiments.shown import (
    MEAN_TITLE,
    NOT_APPLICABLE,
    Block,
    Label,
    Section,
    ShownCell,
    formatted,
)
from polarguide.experiments.shown import Row as ShownRow

BySceneAndSeed = Mapping[str, Mapping[int, float]]


def shown_columns(results: Results) -> tuple[Metric, ...]:
    """The columns that people see: those with a value in some row."""
    return tuple(
        column
        for column in COLUMNS
        if column.shown == "tables" and any(_cell_of(row, column)["count"] for row in results["table"])
    )


def scores_section(results: Results) -> Section:
    """The table by scenes, formatted, with the leaders of every column marked."""
    columns = shown_columns(results)
    titles: dict[str | None, str] = {row["scene"]: row["scene"] or MEAN_TITLE for row in results["table"]}
    steps = {recipe["name"]: recipe["steps"] for recipe in results["recipes"] if "steps" in recipe}
    made = []
    for scene, title in titles.items():
        rows = [row for row in results["table"] if row["scene"] == scene]
        bold = [leading_rows(rows, column, results) for column in columns]
        shown = tuple(
            ShownRow(
                (Label(row["recipe"], code=True, remark=_remark(row, results, steps)),),
                tuple(
                    _cell(row, column, index in leaders, results["table"])
                    for column, leaders in zip(columns, bold, strict=True)
                ),
            )
            for index, row in enumerate(rows)
        )
        made.append(Block(title, shown))
    headings = tuple(column.heading for column in columns)
    return Section("scores", "", ("recipe",), headings, tuple(made), tuple(notes(results)))


def leading_rows(rows: Sequence[Row], column: Metric, results: Results) -> set[int]:
    """Which rows of one scene (or of the mean over scenes) have the best value of a column, or one not told from it.

    A row is told from the best by the differences at the same seeds, if they exceed ``training_noise``; where that is
    not known, by the digits shown. None where fewer than two rows have a value, or the column has no better side.
    """
    means = {i: value for i, row in enumerate(rows) if (value := _cell_of(row, column)["mean"]) is not None}
    if column.better is None or len(means) < 2:
        return set()
    scenes = {
        scene["name"]: known_scatter(column.key, scene["black_share"])
        for scene in results["scenes"]
        if rows[0]["scene"] in (None, scene["name"])
    }
    values = {
        i: _by_scene_and_seed(results["runs"], list(scenes), rows[i]["recipe"], column.key) for i in means
    }
    return leaders(means, values, column, scenes)


def leaders(
    means: Mapping[int, float],
    values: Mapping[int, BySceneAndSeed],
    column: Metric,
    scatter: Mapping[str, float | None],
) -> set[int]:
    """Which of several means are the best, or not told from it.

    Args:
        means: shown values. values: what each is a mean of, by scene and seed.
        column: the metric; without a better side there are no leaders.
        scatter: the known scatter by scene.
    """
    if column.better is None or not means:
        return set()
    sign = 1.0 if column.better == "higher" else -1.0
    best = max(means, key=lambda index: sign * means[index])
    return {
        index
        for index in means
        if formatted(means[index], column) == formatted(means[best], column)
        or _not_told(values[best], values[index], sign, scatter)
    }


def _not_told(
    best: BySceneAndSeed, other: BySceneAndSeed, sign: float, scatter: Mapping[str, float | None]
) -> bool:
    """Whether the lead of the best over another, at the seeds that both have, is within noise."""
    leads = {
        scene: {
            seed: sign * (value - other[scene][seed]) for seed, value in seeds.items() if seed in other[scene]
        }
        for scene, seeds in best.items()
        if scene in other
    }
    if set(leads) != set(best) | set(other) or not all(leads.values()):
        return False
    half = training_noise(leads, scatter)
    return half is not None and mean(mean(by_seed.values()) for by_seed in leads.values()) <= half


def _by_scene_and_seed(
    runs: Sequence[RunRecord], scenes: Sequence[str], recipe: str, key: str
) -> BySceneAndSeed:
    found: dict[str, dict[int, float]] = {}
    for run in runs:
        value = (run["metrics"] or {}).get(key)
        if value is not None and run["scene"] in scenes and run["recipe"] == recipe:
            found.setdefault(run["scene"], {})[run["seed"]] = value
    return found


def notes(results: Results) -> list[str]:
    """What a reader of the scores has to know, a sentence each."""
    said = [
        "↑ higher is better, ↓ lower is better.",
        "Bold: the best of each scene and column, and whatever differs from it by no more than another seed may "
        "change, with 95 % confidence: by the paired differences where three seeds are paired, else by the known "
        "scatter of such differences; in a column without one, what shows the same digits.",
    ]
    counts = seed_counts(results)
    if len(counts) > 1:
        said.append("The number of seeds differs between rows: it stands after the name.")
    if max(counts) > 1:
        number = f"{counts[0]} " if len(counts) == 1 else ""
        said.append(f"Mean ± sample standard deviation over {number}seeds.")
    if min(counts) < 2:
        said.append("Of one seed, what another would change is not in the table.")
    if len(results["scenes"]) > 1:
        said.append(
            "Mean over scenes: over those where any recipe has a value of the column, with one weight each."
        )
    said += [f"{scene['name']}: {text}" for scene in results["scenes"] for text in scene.get("warnings", ())]
    done = [run for run in results["runs"] if run["state"] == "done"]
    for label, reasons in (
        ("LPIPS", (run["lpips_reason"] for run in done)),
        (MESH_LABEL, (run.get("mesh_reason") for run in done)),
    ):
        said += [f"{label} {NOT_APPLICABLE}: {reason}." for reason in dict.fromkeys(reasons) if reason]
    unfinished = [r for r in results["runs"] if r["state"] != "done"]
    for run in unfinished:
        what = "failed" if run["state"] == "failed" else "has not finished"
        error = f": {run['error']}" if run["error"] else ""
        said.append(f"{run['scene']}, {run['recipe']}, seed {run['seed']} {what}{error}")
    return said


def seed_counts(results: Results) -> list[int]:
    """How many seeds were asked for: one number, or several where recipes or scenes differ in it; ascending."""
    return sorted(set(Counter((run["scene"], run["recipe"]) for run in results["runs"]).values()))


def _remark(row: Row, results: Results, steps: Mapping[str, int]) -> str:
    """Its number of steps where that is not the others' number, and what is missing of a row."""
    own = f"{steps[row['recipe']]:,} steps" if row["recipe"] in steps else ""
    return ", ".join(filter(None, (own, _missing(row, results))))


def _missing(row: Row, results: Results) -> str:
    """What is missing of a row; else how many seeds it has, where rows differ in that."""
    planned = [
        run
        for run in results["runs"]
        if run["recipe"] == row["recipe"] and row["scene"] in (None, run["scene"])
    ]
    done = sum(run["state"] == "done" for run in planned)
    if planned and not done:
        return "failed" if any(run["state"] == "failed" for run in planned) else "missing"
    what = "runs" if row["scene"] is None else "seeds"
    if done < len(planned):
        return f"{done} of {len(planned)} {what}"
    if row["scene"] is not None and len(seed_counts(results)) > 1:
        return f"{done} seed{'' if done == 1 else 's'}"
    return ""


def _cell_of(row: Row, column: Metric) -> Cell:
    """A record of an older version lacks the metrics that came later."""
    return row["cells"].get(column.key, NO_VALUE)


def _cell(row: Row, column: Metric, bold: bool, table: Sequence[Row]) -> ShownCell:
    cell = _cell_of(row, column)
    if cell["mean"] is None:
        # A speed that was not measured alone, or a run that has not finished, is not "not applicable".
        known = row["scene"] is None and any(
            other["recipe"] == row["recipe"] and _cell_of(other, column)["count"] for other in table
        )
        return ShownCell("" if column.timed or not row["finished"] or known else NOT_APPLICABLE)
    spread = "" if cell["spread"] is None else f"± {formatted(cell['spread'], column)}"
    return ShownCell(formatted(cell["mean"], column), spread, bold)
