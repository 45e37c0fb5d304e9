"""Many runs -> the rows of a table: means and spreads over seeds, and over scenes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Annotated, TypedDict

import msgspec

from polarguide.evaluation.table import COLUMNS


class PartScores(TypedDict):
    """What a run scores on an object, or on all objects of a material.

    ``pixels`` counts those of all test views, ``views`` the test views that show it; ``metrics`` holds numbers or None
    by key. ``material`` is the class of material, None where it is not known.
    """

    material: str | None
    pixels: Annotated[int, msgspec.Meta(ge=0)]
    views: Annotated[int, msgspec.Meta(ge=0)]
    metrics: dict[str, float | None]


class _Run(TypedDict):
    scene: str
    recipe: str
    seed: Annotated[int, msgspec.Meta(ge=0)]
    folder: str
    state: str
    error: str | None
    metrics: dict[str, float | None] | None
    lpips_reason: str | None
    views: dict[str, dict[str, float | None]]
    objects: dict[str, PartScores]
    materials: dict[str, PartScores]


class RunRecord(_Run, total=False):
    """One training: what it was, the state of its work, and its scores.

    ``metrics`` holds numbers or None by key, and is None unless the run is done; ``views`` holds the same for each test
    view, ``objects`` for each object by name, ``materials`` for each class of material; the last two are empty where
    the scene has no table of objects. ``folder`` is relative to that of the record.
    ``lpips_reason`` and ``mesh_reason`` say why these have no value; records of earlier versions lack the second.
    """

    mesh_reason: str | None


class Cell(TypedDict):
    """One quantity of one row.

    ``mean`` is None where no run has a value; ``spread`` is the sample standard deviation over seeds, None with fewer
    than two; ``count`` is the number of seeds with a value.
    """

    mean: float | None
    spread: float | None
    count: int


class Row(TypedDict):
    """One recipe on one scene (``scene`` None: the mean over scenes), of ``finished`` runs."""

    scene: str | None
    recipe: str
    finished: int
    cells: dict[str, Cell]


NO_VALUE = Cell(mean=None, spread=None, count=0)


def aggregate(runs: Sequence[RunRecord], scenes: Sequence[str], recipes: Sequence[str]) -> list[Row]:
    """The table of a comparison.

    Args:
        runs: in any order; those that have not finished count for nothing.
        scenes, recipes: names, in the order in which rows are wanted.

    Returns:
        A row for every scene and recipe, and, with several scenes, one for the mean over scenes of every recipe. In
        that mean every scene has one weight, and a quantity is given only where the recipe has it on every scene on
        which any recipe has it: means over different scenes are not to be compared.
    """
    rows = [_scene_row(runs, scene, recipe) for scene in scenes for recipe in recipes]
    if len(scenes) > 1:
        rows += [_mean_row(runs, rows, scenes, recipe) for recipe in recipes]
    return rows


def _finished(
    runs: Sequence[RunRecord], scene: str, recipe: str
) -> list[tuple[int, dict[str, float | None]]]:
    """Seeds and metrics."""
    return [
        (run["seed"], run["metrics"])
        for run in runs
        if run["scene"] == scene and run["recipe"] == recipe and run["metrics"] is not None
    ]


def _scene_row(runs: Sequence[RunRecord], scene: str, recipe: str) -> Row:
    finished = _finished(runs, scene, recipe)
    cells = {m.key: cell_of([metrics.get(m.key) for _, metrics in finished]) for m in COLUMNS}
    return Row(scene=scene, recipe=recipe, finished=len(finished), cells=cells)


def _mean_row(runs: Sequence[RunRecord], rows: Sequence[Row], scenes: Sequence[str], recipe: str) -> Row:
    own = {row["scene"]: row for row in rows if row["recipe"] == recipe}
    cells: dict[str, Cell] = {}
    for key in (metric.key for metric in COLUMNS):
        wanted = [s for s in scenes if any(r["scene"] == s and r["cells"][key]["count"] for r in rows)]
        means = [own[scene]["cells"][key]["mean"] for scene in wanted]
        numbers = [mean for mean in means if mean is not None]
        if not numbers or len(numbers) < len(wanted):
            cells[key] = NO_VALUE
            continue
        over_seeds = cell_of(list(_by_seed(runs, wanted, recipe, key).values()))
        cells[key] = Cell(
            mean=math.fsum(numbers) / len(numbers), spread=over_seeds["spread"], count=over_seeds["count"]
        )
    return Row(scene=None, recipe=recipe, finished=sum(r["finished"] for r in own.values()), cells=cells)


def _by_seed(runs: Sequence[RunRecord], scenes: Sequence[str], recipe: str, key: str) -> dict[int, float]:
    """The mean over scenes of every seed that has a value on all of them."""
    values: dict[int, list[float]] = {}
    for scene in scenes:
        for seed, metrics in _finished(runs, scene, recipe):
            value = metrics.get(key)
            if value is not None:
                values.setdefault(seed, []).append(value)
    return {seed: math.fsum(v) / len(v) for seed, v in values.items() if len(v) == len(scenes)}


def cell_of(values: Sequence[float | None]) -> Cell:
    """Mean and sample standard deviation of what is not None."""
    numbers = [float(value) for value in values if value is not None]
    return Cell(
        mean=math.fsum(numbers) / len(numbers) if numbers else None,
        spread=statistics.stdev(numbers) if len(numbers) > 1 else None,
        count=len(numbers),
    )
