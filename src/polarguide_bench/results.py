"""Results of a comparison: its record, the data frames that follow from it, and their statistics.

These are paired differences between recipes, how sure they are, and which of them are noise.
``docs/explanation/statistics.md`` gives the formulas and says what each interval is over.

The record of a comparison, as ``results.json`` has it: its types, and the check of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean, stdev
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
import pandas as pd
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray
from scipy import stats

from polarguide.core.errors import PolarguideError
from polarguide.core.records import read_record, shortened
from polarguide.results.evaluation.table import COLUMNS, PART_METRICS, Metric

FORMAT = "polarguide-results-2"
FORMER = "polarguide-results-1"
"""Lacks objects, materials, black pixels, the recipe to compare with, and differences."""
REMEDY = "Give the command again to write the record anew."
_Item = TypeVar("_Item")
_Filled = Annotated[list[_Item], Meta(min_length=1)]
Count = Annotated[int, Meta(ge=0)]
Scores = dict[str, float | None]
"""Metrics by key; None: the recipe or the ground truth gives no value."""


class Provenance(msgspec.Struct):
    """How the record was made. ``sources``: digest of the code that trains and scores; ``date``: ISO 8601, UTC."""

    version: str
    commit: str | None
    sources: str
    command: str
    date: str


class Settings(msgspec.Struct):
    """Settings that all runs share; ``jobs`` of them worked at a time, 0: as many as had room. ``against``: what others
    are compared with.

    The first records lack the last ones: surroundings were taken to be there, and metals not sought.
    """

    steps: int
    seeds: int
    downscale: int
    transfer: str
    refractive_index: float | None
    threads: int
    jobs: int
    against: str | None = None
    background: str = "scene"
    materials: str = "dielectric"

    def __post_init__(self) -> None:
        if self.refractive_index == 0:  # as earlier records have it for null
            self.refractive_index = None


class SceneRecord(msgspec.Struct):
    """A scene: the digest of its files, how many views it has, and the names of those that scores are means over.

    ``black_share`` is the share of black pixels in its first test view, None where that is not known.
    ``warnings``, only where there are some, are what its scores do not mean because ground truth is missing.
    ``refractive_index`` is that of its runs, where ``Settings`` have null: each scene its own.
    """

    name: str
    digest: str
    views: Count
    test_views: list[str]
    black_share: Annotated[float, Meta(ge=0, le=1)] | None = None
    warnings: list[str] | UnsetType = UNSET
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | UnsetType = UNSET


class RecipeRecord(msgspec.Struct):
    """A recipe with all its values; ``steps`` only where it takes another number of them than ``Settings`` say."""

    name: str
    about: str
    data: dict[str, Any]
    steps: Annotated[int, Meta(ge=1)] | UnsetType = UNSET


class PartScores(msgspec.Struct):
    """Scores of a run on an object, or on all objects of a material.

    ``pixels`` counts those of all test views, ``views`` the test views that show it. ``material`` is the class of
    material, None where it is not known.
    """

    material: str | None
    pixels: Count
    views: Count
    metrics: Scores


class RunRecord(msgspec.Struct, kw_only=True):
    """One training: what it was, the state of its work, and its scores.

    ``metrics`` is None unless the run is done; ``views`` holds those of each test view, ``objects`` of each object by
    name, ``materials`` of each class of material; the last two are empty where the scene has no table of objects.
    ``folder`` is relative to that of the record. ``lpips_reason`` and ``mesh_reason`` say why these have no value;
    records of earlier versions lack the second.
    """

    scene: str
    recipe: str
    seed: Count
    folder: str
    state: Literal["done", "failed", "missing"]
    error: str | None
    metrics: Scores | None
    lpips_reason: str | None
    mesh_reason: str | UnsetType | None = UNSET
    views: dict[str, Scores]
    objects: dict[str, PartScores] = {}
    materials: dict[str, PartScores] = {}


class Record(msgspec.Struct):
    """A comparison: its request, and the scores of every run. Tables and differences follow from it.

    Raises:
        PolarguideError: names that occur twice, or runs of other scenes and recipes.
    """

    format: str
    provenance: Provenance
    settings: Settings
    scenes: _Filled[SceneRecord]
    recipes: _Filled[RecipeRecord]
    runs: _Filled[RunRecord]

    def __post_init__(self) -> None:
        _require("format", self.format, (FORMAT, FORMER))
        self.format = FORMAT
        names = {"scene": [s.name for s in self.scenes], "recipe": [r.name for r in self.recipes]}
        for kind, names_of_kind in names.items():
            if len(set(names_of_kind)) < len(names_of_kind):
                raise _fault(f"{kind}s", "no name more than once", names_of_kind)
        _require("settings.against", self.settings.against, [*names["recipe"], None])
        for index, run in enumerate(self.runs):
            for kind, names_of_kind in names.items():
                _require(f"runs[{index}].{kind}", getattr(run, kind), names_of_kind)
            if (run.metrics is None) == (run.state == "done"):
                raise _fault(
                    f"runs[{index}].metrics",
                    "values for a run that is done and null for another",
                    run.metrics,
                )


def read_results(path: Path) -> Record:
    """Read ``results.json``, of this version or the one before.

    Raises:
        PolarguideError: there is none, or it is not what a comparison writes; the message names the key at fault.
    """
    return read_record(path, Record, remedy=REMEDY)


def _require(where: str, value: object, allowed: object) -> None:
    if value not in allowed:  # type: ignore[operator]
        raise _fault(where, "one of " + ", ".join(str(name) for name in allowed if name is not None), value)  # type: ignore[attr-defined]


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=shortened(found), remedy=REMEDY)


Numbers = NDArray[np.float64]
Values = dict[str, Numbers]
"""A metric by scene: [recipes, seeds, units], NaN where there is no value. Units are test views, or one for the run."""

CONFIDENCE = 0.95
LEAST_UNITS = 3
"""Fewest seeds, views or scenes for an interval. With two, it is 13 times as wide as their difference."""
NORMAL_QUANTILE = float(stats.norm.ppf((1 + CONFIDENCE) / 2))
KNOWN_SCATTER: Mapping[str, float] = {
    "psnr": 0.23,
    "psnr_foreground": 0.113,
    "psnr_reflective": 0.143,
    "ssim": 0.00126,
    "normal_mae_deg": 0.46,
    "normal_within_11": 0.0093,
    "specular_psnr": 0.28,
    "diffuse_psnr": 0.28,
    "specular_psnr_aligned": 0.28,
    "diffuse_psnr_aligned": 0.28,
}
"""Standard deviation over seeds of the difference between two recipes at the same seed on one scene, by metric.

Its origin stands in ``docs/explanation/statistics.md``."""
KNOWN_SCATTER_ON_BLACK: Mapping[str, float] = {**KNOWN_SCATTER, "psnr": 1.5}
"""The same where the background is black: fog before it, which a seed decides on, makes up the error of the picture."""
BLACK_SHARE = 0.25
"""From this share of black pixels on, a scene is one on black."""
CONTROL = "unpolarized"
"""``R:unpolarized`` and ``R:unpolarized-...`` are the controls of ``R``: the same without what polarization tells."""


def controlled(recipes: Sequence[str]) -> dict[str, list[str]]:
    """The recipes that have controls among them, each with these."""
    by_recipe = {
        recipe: [name for name in recipes if f"{name}-".startswith(f"{recipe}:{CONTROL}-")]
        for recipe in recipes
    }
    return {recipe: controls for recipe, controls in by_recipe.items() if controls}


def known_scatter(key: str, black_share: float | None) -> float | None:
    """The known scatter of a metric on a scene with this share of black pixels (None: not known, taken as small)."""
    black = black_share is not None and black_share >= BLACK_SHARE
    return (KNOWN_SCATTER_ON_BLACK if black else KNOWN_SCATTER).get(key)


def values_of(
    record: Record, value: Callable[[RunRecord], Mapping[str, float | None]], scenes: Iterable[str] = ()
) -> Values:
    """``value`` of every run by unit, of the scenes that have any (all, or those that are named)."""
    recipes = {recipe.name: index for index, recipe in enumerate(record.recipes)}
    seeds = {seed: index for index, seed in enumerate(sorted({run.seed for run in record.runs}))}
    values: Values = {}
    for scene in scenes or [scene.name for scene in record.scenes]:
        runs = [(run, value(run)) for run in record.runs if run.scene == scene]
        units = dict.fromkeys(unit for _, of in runs for unit, number in of.items() if number is not None)
        if units:
            values[scene] = np.full((len(recipes), len(seeds), len(units)), np.nan)
        for run, of in runs if units else ():
            values[scene][recipes[run.recipe], seeds[run.seed]] = np.array([of.get(u) for u in units], float)
    return values


def metric_of_runs(key: str) -> Callable[[RunRecord], dict[str, float | None]]:
    """For ``values_of``: a metric of every run as a whole."""
    return lambda run: {"": (run.metrics or {}).get(key)}


def metric_of_views(metric: Metric) -> Callable[[RunRecord], dict[str, float | None]]:
    """For ``values_of``: a metric of every test view, if it is one of views."""
    if metric.of == "run":
        return metric_of_runs(metric.key)
    return lambda run: {view: scores.get(metric.key) for view, scores in run.views.items()}


def shared(values: Numbers) -> Numbers:
    """Values [recipes, seeds, units] that several recipes share: units that all have with every shared seed.

    Rows of other seeds are NaN. Without anything in common, no unit is left.
    """
    there = ~np.asarray(np.isnan(values).any(axis=0))
    seeds = there.any(axis=1)
    units = there[seeds].all(axis=0) & seeds.any()
    return np.asarray(np.where(there, values, np.nan)[:, :, units])


def paired(of: Numbers, other: Numbers) -> Numbers:
    """Differences ``of - other`` [seeds, units] at the seeds and units that both have: see ``shared``."""
    both = shared(np.stack([of, other]))
    return np.asarray(both[0] - both[1])


def known(values: Numbers) -> list[float]:
    """The numbers that are not NaN."""
    return list(values[~np.isnan(values)].tolist())


def seed_means(differences: Iterable[Numbers]) -> Numbers:
    """Means over units [scenes, seeds] of the differences of several scenes; NaN where a seed is not paired."""
    return np.array([[fmean(known(row)) if known(row) else np.nan for row in d] for d in differences])


def _means_by_seed(by_seed: Numbers) -> list[float]:
    """Means over scenes of [scenes, seeds], of every seed that all scenes have."""
    return [fmean(column) for column in by_seed.T.tolist() if not any(map(math.isnan, column))]


def t_half_width(values: Sequence[float]) -> float:
    """Half the width of Student's 95 % confidence interval of the mean of two or more independent values."""
    error = stdev(values) / math.sqrt(len(values))
    return float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1)) * error


def estimate(differences: Sequence[Numbers], scatter: Sequence[float | None]) -> dict[str, Any]:
    """The mean of paired differences, how sure it is, and whether it may be noise.

    The interval is over scenes if there are at least three; else over seeds, if at least three are paired on every
    scene; else, of one scene, over its test views: this one holds for these trainings only. The difference may be
    noise if its interval holds 0, and, where this is not over seeds or scenes, if another seed may turn it.

    Args:
        differences: for each scene, what ``paired`` gives, not empty.
        scatter: the known scatter on each scene.

    Returns:
        ``mean``; ``low`` and ``high``, the 95 % confidence interval, None where there are too few for one; ``over``,
        the unit whose scatter it is, and their ``count``, None and 0 without one; the paired ``seeds`` (of several
        scenes: on the one with the fewest); ``noise``, None where that is not known.
    """
    by_seed = seed_means(differences)
    means = [fmean(known(row)) for row in by_seed]
    units = {"scenes": means, "seeds": _means_by_seed(by_seed)}
    if len(means) == 1:
        units["views"] = [fmean(known(column)) for column in differences[0].T]
    over = next((name for name, values in units.items() if len(values) >= LEAST_UNITS), None)
    mean = fmean(means)
    half = None if over is None else t_half_width(units[over])
    noise = half is not None and abs(mean) <= half
    return {
        "mean": mean,
        "low": None if half is None else mean - half,
        "high": None if half is None else mean + half,
        "over": over,
        "count": len(units[over]) if over else 0,
        "seeds": min(len(known(row)) for row in by_seed),
        "noise": noise if noise or over in ("seeds", "scenes") else is_noise(by_seed, scatter),
    }


def training_noise(by_seed: Numbers, scatter: Sequence[float | None]) -> float | None:
    """How large a mean difference between two recipes can be by chance, at the same seeds on the same scenes.

    Args:
        by_seed: differences [scenes, seeds], NaN where a seed is not paired; every scene has at least one.
        scatter: the known scatter on each scene.

    Returns:
        Half the width of the 95 % confidence interval over seeds: from the seeds themselves if at least three are on
        every scene, else from the known scatter; None where neither is there.
    """
    values = _means_by_seed(by_seed)
    if len(values) >= LEAST_UNITS:
        return t_half_width(values)
    if None in scatter:
        return None
    variances = [(s or 0.0) ** 2 / len(known(row)) for s, row in zip(scatter, by_seed, strict=True)]
    return NORMAL_QUANTILE * math.sqrt(math.fsum(variances)) / len(by_seed)


def is_noise(by_seed: Numbers, scatter: Sequence[float | None]) -> bool | None:
    """Whether a difference is within ``training_noise``; None where that is not known."""
    half = training_noise(by_seed, scatter)
    return None if half is None else abs(fmean(fmean(known(row)) for row in by_seed)) <= half


def pair(
    record: Record,
    values: Values,
    recipe: str,
    others: Sequence[str],
    column: Metric,
    *,
    scatter: bool = True,
) -> dict[str, Any] | None:
    """A recipe beside the better of others, by their means over the seeds and units that all of them have.

    Args:
        values: what all scenes of it count for.
        recipe: the recipe. others: what to choose from; the first of equal ones is taken.
        column: the metric, which has a better side.
        scatter: whether the known scatter holds for these values.

    Returns:
        What ``estimate`` gives, ``other``, and those ``left_out`` that had no runs to pair; None where there is nothing
        to pair, or nothing that all have and the choice could rest on.
    """
    place = {entry.name: index for index, entry in enumerate(record.recipes)}
    pairs = {o: [paired(v[place[recipe]], v[place[o]]) for v in values.values()] for o in others}
    whole = [other for other in others if values and all(apart.size for apart in pairs[other])]
    if not whole:
        return None
    chosen = whole[0]
    if len(whole) > 1:
        every = [shared(v[[place[name] for name in (recipe, *whole)]]) for v in values.values()]
        if not all(v.size for v in every):
            return None
        sign = 1 if column.better == "higher" else -1
        levels = [fmean([x for v in every for x in known(v[1 + k])]) * sign for k in range(len(whole))]
        chosen = whole[levels.index(max(levels))]
    scatters = scatter_on(record, values, column) if scatter else [None] * len(values)
    left_out = [o for o in others if o not in whole]
    return {"other": chosen, **estimate(pairs[chosen], scatters), "left_out": left_out}


def scatter_on(record: Record, scenes: Iterable[str], column: Metric) -> list[float | None]:
    """The known scatter of a metric on each of several scenes."""
    black = {scene.name: scene.black_share for scene in record.scenes}
    return [known_scatter(column.key, black[scene]) for scene in scenes]


def told_apart(
    values: Values, best: int, other: int, sign: float, scatter: Sequence[float | None]
) -> bool | None:
    """True where the lead of one recipe over another, at the seeds that both have on every scene, is beyond noise.

    None where that cannot be tested: no seeds are paired, or too few without a known scatter.
    """
    there = {scene: v for scene, v in values.items() if not np.isnan(v[[best, other]]).all()}
    leads = [sign * paired(v[best], v[other]) for v in there.values()]
    if not leads or not all(lead.size for lead in leads):
        return None
    by_seed = seed_means(leads)
    half = training_noise(by_seed, [s for s, scene in zip(scatter, values, strict=True) if scene in there])
    return None if half is None else fmean(fmean(known(row)) for row in by_seed) > half


def differences(record: Record, compared: Sequence[Metric]) -> list[dict[str, Any]]:
    """All differences that finished runs give, scene by scene, then over scenes.

    Over scenes there is one only where both recipes have runs to pair on every scene on which any recipe has a value.
    ``docs/reference/formats.md`` has the fields.
    """
    recipes = [recipe.name for recipe in record.recipes]
    scenes: list[str | None] = [scene.name for scene in record.scenes]
    values = {column.key: values_of(record, metric_of_views(column)) for column in compared}
    pairs = [("control", recipe, controls) for recipe, controls in controlled(recipes).items()]
    against = record.settings.against
    if against is not None:
        pairs += [("against", recipe, [against]) for recipe in recipes if recipe != against]
    rows = []
    for scene in [*scenes, None] if len(scenes) > 1 else scenes:
        for why, recipe, others in pairs:
            for column in compared:
                of = {s: v for s, v in values[column.key].items() if scene in (None, s)}
                of_pair = pair(record, of, recipe, others, column)
                if of_pair is not None:
                    named = {"scene": scene, "recipe": recipe, "other": "", "why": why, "metric": column.key}
                    rows.append(named | of_pair)
    return rows


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


class ScoreRow(NamedTuple):
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
    def table(self) -> list[ScoreRow]:
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
                rows.append(ScoreRow(scene, recipe, finished, cells))
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
