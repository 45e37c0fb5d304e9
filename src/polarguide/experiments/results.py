"""Results of a comparison: its record, and the data frames that follow from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import fmean, stdev
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from polarguide.experiments.record import PartScores, Record
from polarguide.experiments.statistics import differences, known, metric_of_runs, values_of
from polarguide.results.evaluation.table import COLUMNS, PART_METRICS, Metric

COMPARED = tuple(column for column in COLUMNS if column.better is not None and not column.timed)
"""The metrics of which differences are taken: those that have a better side and do not depend on the machine."""
DIFFERENCE_FIELDS = (
    "scene", "recipe", "other", "why", "metric", "mean", "low", "high", "over", "count", "seeds", "noise",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """A metric of a recipe on a scene: mean over seeds, sample standard deviation (None: of one seed), seeds."""

    mean: float | None = None
    spread: float | None = None
    count: int = 0


def cell_of(values: Sequence[float | None]) -> Cell:
    """Mean and spread of what is not None."""
    numbers = [value for value in values if value is not None]
    spread = stdev(numbers) if len(numbers) > 1 else None
    return Cell(fmean(numbers), spread, len(numbers)) if numbers else Cell()


class Row(NamedTuple):
    """One recipe on one scene (None: the mean over scenes), of ``finished`` runs; cells by metric."""

    scene: str | None
    recipe: str
    finished: int
    cells: dict[str, Cell]


@dataclass(frozen=True)
class Results:
    """A comparison. In each frame a value that is not there is NaN or None.

    Attributes:
        record: everything that ``results.json`` has, but the tables, which follow from it.
    """

    record: Record

    @property
    def scenes(self) -> list[str]:
        """Names, in the order of the tables."""
        return [scene.name for scene in self.record.scenes]

    @property
    def recipes(self) -> list[str]:
        """Names, in the order of the tables."""
        return [recipe.name for recipe in self.record.recipes]

    @cached_property
    def runs(self) -> pd.DataFrame:
        """A row for every run: scene, recipe, seed, state (done, failed, missing), error, folder, and each metric."""
        named = ("scene", "recipe", "seed", "state", "error", "folder")
        rows = [{k: getattr(run, k) for k in named} | (run.metrics or {}) for run in self.record.runs]
        return _frame(rows, named, [column.key for column in COLUMNS])

    @cached_property
    def scores(self) -> pd.DataFrame:
        """A row for every scene (None: mean over scenes) and recipe: finished ``runs``, each metric and its spread."""
        rows = [[row.scene, row.recipe, row.finished, *_pairs(row.cells.values())] for row in self.table]
        return _frame(rows, ("scene", "recipe", "runs"), _with_spreads(COLUMNS))

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Paired differences ``recipe - other`` in a metric, with interval and noise; ``scene`` None: over scenes."""
        frame = pd.DataFrame(self.compared, columns=[*DIFFERENCE_FIELDS])
        return frame.astype({"mean": float, "low": float, "high": float})

    @cached_property
    def parts(self) -> pd.DataFrame:
        """Scores by object and by material of every scene and recipe, means over its seeds with their spreads."""
        scores: dict[tuple[str, ...], list[PartScores]] = {}
        for run in self.record.runs:
            for kind, scored in (("object", run.objects), ("material", run.materials)):
                for name, part in scored.items():
                    scores.setdefault((run.scene, run.recipe, kind, name), []).append(part)
        rows = []
        for place, seeds in scores.items():
            cells = [cell_of([part.metrics.get(column.key) for part in seeds]) for column in PART_METRICS]
            rows.append(
                [*place, seeds[0].material, seeds[0].pixels, seeds[0].views, len(seeds), *_pairs(cells)]
            )
        head = ("scene", "recipe", "part", "name", "material", "pixels", "views", "runs")
        return _frame(rows, head, _with_spreads(PART_METRICS))

    @cached_property
    def compared(self) -> list[dict[str, Any]]:
        """The differences as ``results.json`` has them."""
        return differences(self.record, COMPARED)

    @cached_property
    def table(self) -> list[Row]:
        """A row for every scene and recipe, and, with several scenes, one for the mean over scenes of every recipe.

        In that mean every scene has one weight, and a quantity is given only where the recipe has it on every scene on
        which any recipe has it: means over different scenes are not to be compared.
        """
        values = {column.key: values_of(self.record, metric_of_runs(column.key)) for column in COLUMNS}
        rows = []
        for scene in [*self.scenes, None] if len(self.scenes) > 1 else self.scenes:
            for index, recipe in enumerate(self.recipes):
                scored = [r.scene for r in self.record.runs if r.recipe == recipe and r.metrics is not None]
                cells = {}
                for key, of in values.items():
                    numbers = [v[index, :, 0] for s, v in of.items() if scene in (None, s)]
                    cells[key] = cell_of(known(numbers[0])) if scene and numbers else _over_scenes(numbers)
                finished = len(scored) if scene is None else scored.count(scene)
                rows.append(Row(scene, recipe, finished, cells))
        return rows

    def content(self) -> dict[str, Any]:
        """The content of ``results.json``."""
        table = [row._asdict() for row in self.table]
        tables = msgspec.to_builtins({"table": table, "differences": self.compared})
        return {**msgspec.to_builtins(self.record), **tables}


def _over_scenes(numbers: Sequence[Any]) -> Cell:
    """The mean over scenes of a recipe's values by seed; nothing where a scene has none."""
    if not numbers or not all(known(seeds) for seeds in numbers):
        return Cell()
    complete = [fmean(seeds) for seeds in np.transpose(numbers).tolist() if not np.isnan(seeds).any()]
    return replace(cell_of(complete), mean=fmean(fmean(known(seeds)) for seeds in numbers))


def _frame(rows: list[Any], names: Sequence[str], numbers: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=[*names, *numbers]).astype(dict.fromkeys(numbers, float))


def _with_spreads(columns: Sequence[Metric]) -> list[str]:
    return [name for column in columns for name in (column.key, f"{column.key}_spread")]


def _pairs(cells: Any) -> Iterator[float | None]:
    """Mean and spread of every cell, in turn."""
    return (value for cell in cells for value in (cell.mean, cell.spread))
