"""Results of a comparison as a record (``results.json``), as data frames, and as statistics.

The statistics are paired differences between recipes, their confidence intervals, and their noise due to random seeds.
``docs/explanation/statistics.md`` contains the formulas and the unit of each interval.
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

from polarguide.core.errors import require
from polarguide.core.records import read_record, shortened
from polarguide.results.evaluation.table import COLUMNS, PART_METRICS, Metric

FORMAT = "polarguide-results-2"
REMEDY = "Give the command again to write a new record."
_Item = TypeVar("_Item")
_Filled = Annotated[list[_Item], Meta(min_length=1)]
Count = Annotated[int, Meta(ge=0)]
Scores = dict[str, float | None]
"""Value of each metric by key, or None if the recipe or the ground truth provides no value."""


class Provenance(msgspec.Struct):
    """Provenance of a record.

    Attributes:
        version: version of polarguide.
        commit: commit of the source code, if known.
        sources: digest of the code for training and scoring.
        command: command line of the comparison.
        date: date and time in UTC, ISO 8601.
    """

    version: str
    commit: str | None
    sources: str
    command: str
    date: str


class Settings(msgspec.Struct):
    """Settings of all runs of a comparison. Old records lack the last fields, which then have their default values.

    Attributes:
        steps: training steps.
        seeds: number of seeds.
        downscale: factor by which pictures are reduced.
        transfer: transfer function of the pictures.
        refractive_index: refractive index of all scenes, or None if each scene has its own.
        threads: threads of each run.
        jobs: number of simultaneous runs. 0 means that it was chosen automatically.
        against: reference recipe of the differences.
        background: kind of background.
        materials: kinds of materials.
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


class SceneRecord(msgspec.Struct):
    """Record of a scene in a comparison.

    Attributes:
        name: name of the scene folder.
        digest: digest of the files of the scene.
        views: number of views.
        test_views: names of the test views, over which scores are averaged.
        warnings: sentences about scores that are limited because ground truth is missing. The field is absent without
            warnings.
        refractive_index: refractive index of the scene's runs. The field is present only if ``Settings`` contains None.
    """

    name: str
    digest: str
    views: Count
    test_views: list[str]
    warnings: list[str] | UnsetType = UNSET
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | UnsetType = UNSET


class RecipeRecord(msgspec.Struct):
    """Record of a recipe with all its values. ``steps`` is present only if it differs from ``Settings``."""

    name: str
    about: str
    data: dict[str, Any]
    steps: Annotated[int, Meta(ge=1)] | UnsetType = UNSET


class PartScores(msgspec.Struct):
    """Scores of a run on an object, or on all objects of a material.

    Attributes:
        material: class of the object's material, if known.
        pixels: number of pixels in all test views.
        views: number of test views that show the part.
        metrics: the scores.
    """

    material: str | None
    pixels: Count
    views: Count
    metrics: Scores


class RunRecord(msgspec.Struct, kw_only=True):
    """Record of a run: its training, state and scores.

    Attributes:
        scene: name of the scene.
        recipe: name of the recipe.
        seed: seed of the training.
        folder: run folder, relative to the record.
        state: "done", "failed" or "missing".
        error: reason of a failure, if any.
        metrics: scores of a finished run, or None.
        lpips_reason: reason why LPIPS is missing, if any.
        mesh_reason: reason why the scores of the mesh are missing, if any. Earlier records lack this field.
        views: scores by test view.
        objects: scores by object; empty if the scene has no table of objects.
        materials: scores by class of material; empty if the scene has no table of objects.
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
    """Record of a comparison: its settings, and the scores of each run. Tables and differences are computed from it.

    Raises:
        PolarguideError: a name occurs twice, or a run has an unknown scene or recipe.
    """

    format: str
    provenance: Provenance
    settings: Settings
    scenes: _Filled[SceneRecord]
    recipes: _Filled[RecipeRecord]
    runs: _Filled[RunRecord]

    def __post_init__(self) -> None:
        _require_one_of("format", self.format, (FORMAT,))
        names = {"scene": [s.name for s in self.scenes], "recipe": [r.name for r in self.recipes]}
        for kind, names_of_kind in names.items():
            require(
                len(set(names_of_kind)) == len(names_of_kind),
                f"{kind}s",
                expected="no name more than once",
                found=shortened(names_of_kind),
                remedy=REMEDY,
            )
        _require_one_of("settings.against", self.settings.against, [*names["recipe"], None])
        for index, run in enumerate(self.runs):
            for kind, names_of_kind in names.items():
                _require_one_of(f"runs[{index}].{kind}", getattr(run, kind), names_of_kind)
            require(
                (run.metrics is None) != (run.state == "done"),
                f"runs[{index}].metrics",
                expected="values for a finished run, and null for a run that is not finished",
                found=shortened(run.metrics),
                remedy=REMEDY,
            )


def read_results(path: Path) -> Record:
    """Read a ``results.json``.

    Raises:
        PolarguideError: the file is missing or invalid. The message names the key.
    """
    return read_record(path, Record, remedy=REMEDY)


def _require_one_of(where: str, value: str | None, allowed: Sequence[str | None]) -> None:
    expected = "one of " + ", ".join(filter(None, allowed))
    require(value in allowed, where, expected=expected, found=shortened(value), remedy=REMEDY)


Numbers = NDArray[np.float64]
Values = dict[str, Numbers]
"""Values of a metric by scene: [recipes, seeds, units], NaN if missing. A unit is a test view, or the whole run."""

CONFIDENCE = 0.95
LEAST_UNITS = 3
"""Minimum number of seeds, views or scenes for a confidence interval. With two, the interval is uselessly wide."""
NORMAL_QUANTILE = float(stats.norm.ppf((1 + CONFIDENCE) / 2))
KNOWN_SCATTER: Mapping[str, float] = {
    "psnr": 0.27,
    "psnr_seen": 0.38,
    "psnr_foreground": 0.16,
    "psnr_reflective": 0.2,
    "ssim": 0.0017,
    "flip": 0.0015,
    "normal_mae_deg": 0.46,
    "normal_within_11": 0.0092,
    "specular_psnr": 0.49,
    "diffuse_psnr": 0.7,
    "specular_psnr_aligned": 0.5,
    "diffuse_psnr_aligned": 0.65,
    "stokes_error": 0.012,
    "mesh_fscore_1": 0.027,
}
"""Standard deviation over seeds of the difference between two recipes at the same seed on one scene, by metric.

``docs/explanation/statistics.md`` describes its origin."""
CONTROL = "unpolarized"
"""Name of the variation without polarization, which is the control of a recipe ``R``.

``R:unpolarized`` and ``R:unpolarized-...`` are such controls."""


def controlled(recipes: Sequence[str]) -> dict[str, list[str]]:
    """Return the controls of each recipe, without recipes that have no control."""
    by_recipe = {
        recipe: [name for name in recipes if f"{name}-".startswith(f"{recipe}:{CONTROL}-")]
        for recipe in recipes
    }
    return {recipe: controls for recipe, controls in by_recipe.items() if controls}


def values_of(
    record: Record, value: Callable[[RunRecord], Mapping[str, float | None]], scenes: Iterable[str] = ()
) -> Values:
    """Collect values of all runs by scene. Scenes without values are left out.

    Args:
        record: the record.
        value: function that returns the values of a run by unit.
        scenes: names of the scenes; all if empty.
    """
    recipes = {recipe.name: index for index, recipe in enumerate(record.recipes)}
    seeds = {seed: index for index, seed in enumerate(sorted({run.seed for run in record.runs}))}
    values: Values = {}
    for scene in scenes or [scene.name for scene in record.scenes]:
        runs = [(run, value(run)) for run in record.runs if run.scene == scene]
        units = dict.fromkeys(unit for _, of in runs for unit, number in of.items() if number is not None)
        if units:
            values[scene] = np.full((len(recipes), len(seeds), len(units)), np.nan)
            for run, of in runs:
                numbers = np.array([of.get(unit) for unit in units], float)
                values[scene][recipes[run.recipe], seeds[run.seed]] = numbers
    return values


def metric_of_runs(key: str) -> Callable[[RunRecord], dict[str, float | None]]:
    """Return a function for ``values_of`` that reads a metric of a whole run."""
    return lambda run: {"": (run.metrics or {}).get(key)}


def metric_of_views(metric: Metric) -> Callable[[RunRecord], dict[str, float | None]]:
    """Return a function for ``values_of`` that reads a metric of each test view.

    If a run records no views, the function reads the metric of the whole run.
    """
    if metric.of == "run":
        return metric_of_runs(metric.key)
    return lambda run: {view: scores.get(metric.key) for view, scores in run.views.items()}


def shared(values: Numbers) -> Numbers:
    """Restrict values of several recipes to seeds and units that all recipes have.

    Args:
        values: [recipes, seeds, units].

    Returns:
        [recipes, seeds, shared units]. The values are NaN at a unit and seed that a recipe lacks. Without a shared
        seed, there are no shared units.
    """
    present = ~np.asarray(np.isnan(values).any(axis=0))
    seeds = present.any(axis=1)
    units = present[seeds].all(axis=0) & seeds.any()
    return np.asarray(np.where(present, values, np.nan)[:, :, units])


def paired(of: Numbers, other: Numbers) -> Numbers:
    """Return differences ``of - other`` [seeds, units] at the seeds and units that both recipes have (``shared``)."""
    return np.asarray(np.subtract(*shared(np.stack([of, other]))))


def known(values: Numbers) -> list[float]:
    """Return the numbers that are not NaN."""
    return list(values[~np.isnan(values)].tolist())


def seed_means(differences: Iterable[Numbers]) -> Numbers:
    """Average the differences of each scene over units, [scenes, seeds]. The mean is NaN for a seed without a pair."""
    return np.array([[fmean(known(row)) if known(row) else np.nan for row in d] for d in differences])


def _means_by_seed(by_seed: Numbers) -> list[float]:
    """Average values [scenes, seeds] over scenes, for each seed that all scenes have."""
    return [fmean(column) for column in by_seed.T.tolist() if not any(map(math.isnan, column))]


def t_half_width(values: Sequence[float]) -> float:
    """Return half the width of the 95 % confidence interval (Student's t) for the mean of at least two values."""
    quantile = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1))
    return quantile * (stdev(values) / math.sqrt(len(values)))


def estimate(differences: Sequence[Numbers], scatter: float | None) -> dict[str, Any]:
    """Return the mean of paired differences with its confidence interval and noise.

    With at least three scenes, the interval describes the variation between scenes. With fewer scenes, it describes the
    variation between seeds if each scene has at least three pairs. Otherwise, for a single scene, it describes the
    variation between test views and is valid only for these trainings. The difference may be noise if its interval
    contains 0. With an interval over views, the difference is also compared with the known scatter of seeds.

    Args:
        differences: result of ``paired`` for each scene, not empty.
        scatter: known scatter of the metric, or None.

    Returns:
        A dictionary with these keys. ``mean`` is the mean difference. ``low`` and ``high`` are the ends of the 95 %
        confidence interval, or None. ``over`` is the unit of the interval, or None. ``count`` is the number of units.
        ``seeds`` is the smallest number of paired seeds of a scene. ``noise`` is True if the difference may be noise,
        or None if this is unknown.
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


def training_noise(by_seed: Numbers, scatter: float | None) -> float | None:
    """Return the largest mean difference between two equally good recipes that random seeds can cause.

    Args:
        by_seed: differences [scenes, seeds], NaN for a seed without a pair. Each scene has at least one pair.
        scatter: known scatter of the metric, or None.

    Returns:
        Half the width of the 95 % confidence interval over seeds. If all scenes share at least three seeds, it is
        computed from them, otherwise from the known scatter. None if a known scatter is needed but missing.
    """
    values = _means_by_seed(by_seed)
    if len(values) >= LEAST_UNITS:
        return t_half_width(values)
    if scatter is None:
        return None
    variances = [scatter**2 / len(known(row)) for row in by_seed]
    return NORMAL_QUANTILE * math.sqrt(math.fsum(variances)) / len(by_seed)


def is_noise(by_seed: Numbers, scatter: float | None) -> bool | None:
    """Return True if a difference is at most ``training_noise``, or None if that noise is unknown."""
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
    """Compare a recipe with the best of other recipes.

    The best recipe is chosen from values at seeds and units that all recipes have.

    Args:
        record: the record.
        values: values of the metric on each scene to compare.
        recipe: name of the recipe.
        others: names of the other recipes. If several are equally good, the first is chosen.
        column: the metric, whose better direction is known.
        scatter: True if the known scatter is valid for these values.

    Returns:
        The result of ``estimate`` with two more keys: ``other`` is the chosen recipe, and ``left_out`` lists recipes
        without pairs. None if there are no pairs, or no seeds and units that all recipes have.
    """
    index = {entry.name: number for number, entry in enumerate(record.recipes)}
    pairs = {o: [paired(v[index[recipe]], v[index[o]]) for v in values.values()] for o in others}
    complete = [o for o in others if values and all(difference.size for difference in pairs[o])]
    if not complete:
        return None
    chosen = complete[0]
    if len(complete) > 1:
        common = [shared(v[[index[name] for name in (recipe, *complete)]]) for v in values.values()]
        if not all(v.size for v in common):
            return None
        sign = 1 if column.better == "higher" else -1
        levels = [fmean([x for v in common for x in known(v[1 + k])]) * sign for k in range(len(complete))]
        chosen = complete[levels.index(max(levels))]
    known_scatter = KNOWN_SCATTER.get(column.key) if scatter else None
    left_out = [o for o in others if o not in complete]
    return {"other": chosen, **estimate(pairs[chosen], known_scatter), "left_out": left_out}


def told_apart(values: Values, best: int, other: int, column: Metric, scatter: float | None) -> bool | None:
    """Return True if one recipe is better than another by more than noise in a metric with a better direction.

    The test uses the seeds that both recipes have on each scene. Return None if no test is possible. This is the case
    without paired seeds, or if they are too few and the known scatter is missing.
    """
    sign = 1.0 if column.better == "higher" else -1.0
    present = [v for v in values.values() if not np.isnan(v[[best, other]]).all()]
    leads = [sign * paired(v[best], v[other]) for v in present]
    if not leads or not all(lead.size for lead in leads):
        return None
    by_seed = seed_means(leads)
    half = training_noise(by_seed, scatter)
    return None if half is None else fmean(fmean(known(row)) for row in by_seed) > half


def differences(record: Record, compared: Sequence[Metric]) -> list[dict[str, Any]]:
    """Return all differences between recipes: first for each scene, then over all scenes.

    A difference over scenes needs pairs of both recipes on each scene on which at least one recipe has a value.
    ``docs/reference/formats.md`` describes the fields.
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
                difference = pair(record, of, recipe, others, column)
                if difference is not None:
                    named = {"scene": scene, "recipe": recipe, "other": "", "why": why, "metric": column.key}
                    rows.append(named | difference)
    return rows


DIFFERENCE_FIELDS = (
    "scene", "recipe", "other", "why", "metric", "mean", "low", "high", "over", "count", "seeds", "noise",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """Statistics of one metric for a recipe on a scene.

    Attributes:
        mean: mean over seeds.
        spread: sample standard deviation over seeds, or None for one seed.
        count: number of seeds.
    """

    mean: float | None = None
    spread: float | None = None
    count: int = 0


def cell_of(values: Sequence[float | None]) -> Cell:
    """Return the mean and spread of the values that are not None."""
    numbers = [value for value in values if value is not None]
    spread = stdev(numbers) if len(numbers) > 1 else None
    return Cell(fmean(numbers), spread, len(numbers)) if numbers else Cell()


class ScoreRow(NamedTuple):
    """Row of the scores: a recipe on a scene, or the mean of a recipe over scenes.

    Attributes:
        scene: name of the scene, or None for the mean over scenes.
        recipe: name of the recipe.
        finished: number of finished runs.
        cells: statistics of each metric, by key.
    """

    scene: str | None
    recipe: str
    finished: int
    cells: dict[str, Cell]


@dataclass(frozen=True)
class Results:
    """Results of a comparison as data frames, in which a missing value is NaN or None.

    Attributes:
        record: content of ``results.json``, from which all tables are computed.
    """

    record: Record

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes, in the order of the tables."""
        return [scene.name for scene in self.record.scenes]

    @property
    def recipes(self) -> list[str]:
        """Names of the recipes, in the order of the tables."""
        return [recipe.name for recipe in self.record.recipes]

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Data frame with a row for each run.

        Its columns are scene, recipe, seed, state (done, failed, missing), error, folder, and each metric.
        """
        named = ("scene", "recipe", "seed", "state", "error", "folder")
        rows = [{k: getattr(run, k) for k in named} | (run.metrics or {}) for run in self.record.runs]
        return _frame(rows, named, [column.key for column in COLUMNS])

    @cached_property
    def scores(self) -> pd.DataFrame:
        """Data frame with a row for each recipe on each scene, and for its mean over scenes (scene None).

        Its columns are scene, recipe, the number of finished ``runs``, and each metric with its spread.
        """
        rows = [[row.scene, row.recipe, row.finished, *_numbers(row.cells.values())] for row in self.table]
        return _frame(rows, ("scene", "recipe", "runs"), _with_spreads(COLUMNS))

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Data frame of paired differences ``recipe - other`` in each metric, with confidence interval and noise.

        Rows of differences over all scenes have the scene None.
        """
        frame = pd.DataFrame(self.compared, columns=[*DIFFERENCE_FIELDS])
        return frame.astype({"mean": float, "low": float, "high": float})

    @cached_property
    def parts(self) -> pd.DataFrame:
        """Data frame of scores by object and by material: means over seeds and their spreads."""
        scores: dict[tuple[str, ...], list[PartScores]] = {}
        for run in self.record.runs:
            for kind, scored in (("object", run.objects), ("material", run.materials)):
                for name, part in scored.items():
                    scores.setdefault((run.scene, run.recipe, kind, name), []).append(part)
        rows = []
        for place, (first, *others) in scores.items():
            cells = [cell_of([p.metrics.get(c.key) for p in (first, *others)]) for c in PART_METRICS]
            rows.append(
                [*place, first.material, first.pixels, first.views, 1 + len(others), *_numbers(cells)]
            )
        head = ("scene", "recipe", "part", "name", "material", "pixels", "views", "runs")
        return _frame(rows, head, _with_spreads(PART_METRICS))

    @cached_property
    def compared(self) -> list[dict[str, Any]]:
        """Differences between recipes in the format of ``results.json``.

        The better direction of the compared metrics is known, and they do not depend on the machine.
        """
        return differences(self.record, [c for c in COLUMNS if c.better is not None and not c.timed])

    @cached_property
    def table(self) -> list[ScoreRow]:
        """Rows of the scores: one for each recipe on each scene and, with several scenes, one for each recipe's mean.

        Each scene has the same weight in the mean. A recipe has a mean only if it has a value on each scene on which at
        least one recipe has a value, because means over different scenes are not comparable.
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


def _over_scenes(numbers: Sequence[Any]) -> Cell:
    """Average a recipe's values by seed over scenes. The cell is empty if a scene has no value."""
    if not numbers or not all(known(seeds) for seeds in numbers):
        return Cell()
    complete = [fmean(seeds) for seeds in np.transpose(numbers).tolist() if not np.isnan(seeds).any()]
    return replace(cell_of(complete), mean=fmean(fmean(known(seeds)) for seeds in numbers))


def _frame(rows: list[Any], names: Sequence[str], numbers: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=[*names, *numbers]).astype(dict.fromkeys(numbers, float))


def _with_spreads(columns: Sequence[Metric]) -> list[str]:
    return [name for column in columns for name in (column.key, f"{column.key}_spread")]


def _numbers(cells: Iterable[Cell]) -> Iterator[float | None]:
    """Yield the mean and the spread of each cell, one after the other."""
    return (value for cell in cells for value in (cell.mean, cell.spread))
