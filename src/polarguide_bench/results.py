"""Results of a comparison: the record ``results.json``, data frames and statistics.

The statistics are paired differences between recipes with their confidence intervals and their noise.
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
FORMER = "polarguide-results-1"
"""Previous format, without objects, materials, black pixels, the reference recipe and differences."""
REMEDY = "Give the command again to write a new record."
_Item = TypeVar("_Item")
_Filled = Annotated[list[_Item], Meta(min_length=1)]
Count = Annotated[int, Meta(ge=0)]
Scores = dict[str, float | None]
"""Metrics by key; None if the recipe or the ground truth gives no value."""


class Provenance(msgspec.Struct):
    """Origin of a record.

    Attributes:
        version: version of polarguide.
        commit: commit of its source, if known.
        sources: digest of the code that trains and scores.
        command: command line.
        date: ISO 8601, UTC.
    """

    version: str
    commit: str | None
    sources: str
    command: str
    date: str


class Settings(msgspec.Struct):
    """Settings of all runs of a comparison. The defaults of the last fields hold for records that lack them.

    Attributes:
        steps: training steps.
        seeds: number of seeds.
        downscale: factor by which pictures are reduced.
        transfer: transfer function of the pictures.
        refractive_index: index of all scenes; None if each scene has its own. Earlier records contain 0 instead.
        threads: threads of each run.
        jobs: number of simultaneous runs; 0 if it was automatic.
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

    def __post_init__(self) -> None:
        if self.refractive_index == 0:
            self.refractive_index = None


class SceneRecord(msgspec.Struct):
    """A scene of a comparison.

    Attributes:
        name: name of its folder.
        digest: digest of its files.
        views: number of views.
        test_views: names of the test views. Scores are means over them.
        black_share: share of black pixels in the first test view, if known.
        warnings: limits of the scores because of missing ground truth. Absent without warnings.
        refractive_index: index of its runs. Present only if ``Settings`` contains None.
    """

    name: str
    digest: str
    views: Count
    test_views: list[str]
    black_share: Annotated[float, Meta(ge=0, le=1)] | None = None
    warnings: list[str] | UnsetType = UNSET
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | UnsetType = UNSET


class RecipeRecord(msgspec.Struct):
    """A recipe with all its values. ``steps`` is present only if it differs from ``Settings``."""

    name: str
    about: str
    data: dict[str, Any]
    steps: Annotated[int, Meta(ge=1)] | UnsetType = UNSET


class PartScores(msgspec.Struct):
    """Scores of a run on an object, or on all objects of a material.

    Attributes:
        material: class of the material, if known.
        pixels: number of pixels in all test views.
        views: number of test views that show the part.
        metrics: the scores.
    """

    material: str | None
    pixels: Count
    views: Count
    metrics: Scores


class RunRecord(msgspec.Struct, kw_only=True):
    """A training with its state and scores.

    Attributes:
        scene: name of the scene.
        recipe: name of the recipe.
        seed: seed of the training.
        folder: run folder, relative to the record.
        state: "done", "failed" or "missing".
        error: reason of a failure.
        metrics: scores of a finished run, else None.
        lpips_reason: reason for a missing LPIPS.
        mesh_reason: reason for missing scores of the mesh. Earlier records lack it.
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
    """A comparison: its request, and the scores of each run. Tables and differences are computed from it.

    Raises:
        PolarguideError: a duplicate name, or a run of an unknown scene or recipe.
    """

    format: str
    provenance: Provenance
    settings: Settings
    scenes: _Filled[SceneRecord]
    recipes: _Filled[RecipeRecord]
    runs: _Filled[RunRecord]

    def __post_init__(self) -> None:
        _require_one_of("format", self.format, (FORMAT, FORMER))
        self.format = FORMAT
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
                expected="values for a finished run, and null for another",
                found=shortened(run.metrics),
                remedy=REMEDY,
            )


def read_results(path: Path) -> Record:
    """Read a ``results.json`` of this format or the previous one.

    Raises:
        PolarguideError: the file is missing or invalid. The message names the key.
    """
    return read_record(path, Record, remedy=REMEDY)


def _require_one_of(where: str, value: str | None, allowed: Sequence[str | None]) -> None:
    expected = "one of " + ", ".join(filter(None, allowed))
    require(value in allowed, where, expected=expected, found=shortened(value), remedy=REMEDY)


Numbers = NDArray[np.float64]
Values = dict[str, Numbers]
"""A metric by scene: [recipes, seeds, units], NaN for a missing value. Units are test views, or one for a whole run."""

CONFIDENCE = 0.95
LEAST_UNITS = 3
"""Fewest seeds, views or scenes for an interval. The interval of two is 13 times as wide as their difference."""
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

``docs/explanation/statistics.md`` describes its origin."""
KNOWN_SCATTER_ON_BLACK: Mapping[str, float] = {**KNOWN_SCATTER, "psnr": 1.5}
"""Known scatter on a black background. There, fog dominates the error of the picture and depends on the seed."""
BLACK_SHARE = 0.25
"""Share of black pixels above which a background is black."""
CONTROL = "unpolarized"
"""Variation of a control: ``R:unpolarized`` and ``R:unpolarized-...`` are the recipe ``R`` without polarization."""


def controlled(recipes: Sequence[str]) -> dict[str, list[str]]:
    """Return the controls of each recipe that has controls."""
    by_recipe = {
        recipe: [name for name in recipes if f"{name}-".startswith(f"{recipe}:{CONTROL}-")]
        for recipe in recipes
    }
    return {recipe: controls for recipe, controls in by_recipe.items() if controls}


def known_scatter(key: str, black_share: float | None) -> float | None:
    """Return the known scatter of a metric on a scene with a share of black pixels, which is small if unknown."""
    black = black_share is not None and black_share >= BLACK_SHARE
    return (KNOWN_SCATTER_ON_BLACK if black else KNOWN_SCATTER).get(key)


def values_of(
    record: Record, value: Callable[[RunRecord], Mapping[str, float | None]], scenes: Iterable[str] = ()
) -> Values:
    """Return values of all runs by scene. Scenes without values are left out.

    Args:
        record: the record.
        value: returns the values of a run by unit.
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
    """Return a function for ``values_of`` that reads a metric of each test view, or of a run if it has no views."""
    if metric.of == "run":
        return metric_of_runs(metric.key)
    return lambda run: {view: scores.get(metric.key) for view, scores in run.views.items()}


def shared(values: Numbers) -> Numbers:
    """Return the values that several recipes share: units that all of them have with each shared seed.

    Args:
        values: [recipes, seeds, units].

    Returns:
        [recipes, seeds, shared units]. Rows of other seeds are NaN. There are no units without a shared seed.
    """
    present = ~np.asarray(np.isnan(values).any(axis=0))
    seeds = present.any(axis=1)
    units = present[seeds].all(axis=0) & seeds.any()
    return np.asarray(np.where(present, values, np.nan)[:, :, units])


def paired(of: Numbers, other: Numbers) -> Numbers:
    """Return the differences ``of - other`` [seeds, units] at the seeds and units that both have; see ``shared``."""
    return np.asarray(np.subtract(*shared(np.stack([of, other]))))


def known(values: Numbers) -> list[float]:
    """Return the numbers that are not NaN."""
    return list(values[~np.isnan(values)].tolist())


def seed_means(differences: Iterable[Numbers]) -> Numbers:
    """Return means over units [scenes, seeds] of differences of several scenes; NaN for a seed without a pair."""
    return np.array([[fmean(known(row)) if known(row) else np.nan for row in d] for d in differences])


def _means_by_seed(by_seed: Numbers) -> list[float]:
    """Return means over scenes of values [scenes, seeds], for each seed that all scenes have."""
    return [fmean(column) for column in by_seed.T.tolist() if not any(map(math.isnan, column))]


def t_half_width(values: Sequence[float]) -> float:
    """Return half the width of Student's 95 % confidence interval of the mean of independent values, two at least."""
    quantile = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1))
    return quantile * (stdev(values) / math.sqrt(len(values)))


def estimate(differences: Sequence[Numbers], scatter: Sequence[float | None]) -> dict[str, Any]:
    """Return the mean of paired differences with its confidence interval and noise.

    The interval is over scenes if there are at least three. Otherwise it is over seeds, if each scene has at least
    three pairs. Otherwise, for one scene, it is over test views and holds for these trainings only. The difference
    may be noise if its interval contains 0. An interval over views is also compared with the known scatter of seeds.

    Args:
        differences: result of ``paired`` for each scene, not empty.
        scatter: known scatter on each scene.

    Returns:
        ``mean``; ``low`` and ``high``, the 95 % confidence interval or None; ``over``, the unit of the interval or
        None; ``count``, the number of units; ``seeds``, the smallest number of paired seeds of a scene; ``noise``,
        None if unknown.
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
    """Return the largest mean difference between two recipes that chance explains, at the same seeds and scenes.

    Args:
        by_seed: differences [scenes, seeds], NaN for a seed without a pair. Each scene has at least one pair.
        scatter: known scatter on each scene.

    Returns:
        Half the width of the 95 % confidence interval over seeds. It is computed from the seeds if all scenes share at
        least three, otherwise from the known scatter. None if a scatter is unknown.
    """
    values = _means_by_seed(by_seed)
    if len(values) >= LEAST_UNITS:
        return t_half_width(values)
    if None in scatter:
        return None
    variances = [(s or 0.0) ** 2 / len(known(row)) for s, row in zip(scatter, by_seed, strict=True)]
    return NORMAL_QUANTILE * math.sqrt(math.fsum(variances)) / len(by_seed)


def is_noise(by_seed: Numbers, scatter: Sequence[float | None]) -> bool | None:
    """Return True if a difference is within ``training_noise``; None if that is unknown."""
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
    """Compare a recipe with the best of other recipes. The best is chosen at the seeds and units that all share.

    Args:
        record: the record.
        values: values of the metric on each scene that counts.
        recipe: name of the recipe.
        others: names of the candidates. The first of equal ones is chosen.
        column: the metric. It has a better side.
        scatter: True if the known scatter holds for these values.

    Returns:
        The result of ``estimate`` with ``other``, the chosen recipe, and ``left_out``, candidates without pairs. None
        if there are no pairs, or no values that all candidates share.
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
    scatters = scatter_on(record, values, column) if scatter else [None] * len(values)
    left_out = [o for o in others if o not in complete]
    return {"other": chosen, **estimate(pairs[chosen], scatters), "left_out": left_out}


def scatter_on(record: Record, scenes: Iterable[str], column: Metric) -> list[float | None]:
    """Return the known scatter of a metric on each of several scenes."""
    black = {scene.name: scene.black_share for scene in record.scenes}
    return [known_scatter(column.key, black[scene]) for scene in scenes]


def told_apart(
    values: Values, best: int, other: int, sign: float, scatter: Sequence[float | None]
) -> bool | None:
    """Return True if one recipe leads another beyond noise, at the seeds that both have on each scene.

    None if there is no test: no paired seeds, or too few without a known scatter.
    """
    present = {scene: v for scene, v in values.items() if not np.isnan(v[[best, other]]).all()}
    leads = [sign * paired(v[best], v[other]) for v in present.values()]
    if not leads or not all(lead.size for lead in leads):
        return None
    by_seed = seed_means(leads)
    half = training_noise(by_seed, [s for s, scene in zip(scatter, values, strict=True) if scene in present])
    return None if half is None else fmean(fmean(known(row)) for row in by_seed) > half


def differences(record: Record, compared: Sequence[Metric]) -> list[dict[str, Any]]:
    """Return all differences of finished runs, scene by scene, then over scenes.

    A difference over scenes requires pairs of both recipes on each scene on which any recipe has a value.
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


COMPARED = tuple(column for column in COLUMNS if column.better is not None and not column.timed)
"""Metrics with differences: they have a better side and do not depend on the machine."""
DIFFERENCE_FIELDS = (
    "scene", "recipe", "other", "why", "metric", "mean", "low", "high", "over", "count", "seeds", "noise",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """A metric of a recipe on a scene.

    Attributes:
        mean: mean over seeds.
        spread: sample standard deviation over seeds; None for one seed.
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
    """A recipe on a scene, or its mean over scenes.

    Attributes:
        scene: name of the scene; None for the mean over scenes.
        recipe: name of the recipe.
        finished: number of finished runs.
        cells: cells by metric.
    """

    scene: str | None
    recipe: str
    finished: int
    cells: dict[str, Cell]


@dataclass(frozen=True)
class Results:
    """Results of a comparison. A missing value in a data frame is NaN or None.

    Attributes:
        record: content of ``results.json`` without the tables, which are computed from it.
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
        """A row for each run: scene, recipe, seed, state (done, failed, missing), error, folder, and each metric."""
        named = ("scene", "recipe", "seed", "state", "error", "folder")
        rows = [{k: getattr(run, k) for k in named} | (run.metrics or {}) for run in self.record.runs]
        return _frame(rows, named, [column.key for column in COLUMNS])

    @cached_property
    def scores(self) -> pd.DataFrame:
        """A row for each scene (None: mean over scenes) and recipe: finished ``runs``, metrics and their spreads."""
        rows = [[row.scene, row.recipe, row.finished, *_numbers(row.cells.values())] for row in self.table]
        return _frame(rows, ("scene", "recipe", "runs"), _with_spreads(COLUMNS))

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Paired differences ``recipe - other`` in a metric with interval and noise. Scene None: over scenes."""
        frame = pd.DataFrame(self.compared, columns=[*DIFFERENCE_FIELDS])
        return frame.astype({"mean": float, "low": float, "high": float})

    @cached_property
    def parts(self) -> pd.DataFrame:
        """Scores by object and by material of each scene and recipe: means over seeds with their spreads."""
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
        """Differences in the format of ``results.json``."""
        return differences(self.record, COMPARED)

    @cached_property
    def table(self) -> list[ScoreRow]:
        """A row for each scene and recipe. With several scenes, also a row for the mean over scenes of each recipe.

        Each scene has the same weight in that mean. A recipe has a mean only if it has a value on each scene on which
        any recipe has one, because means over different scenes are not comparable.
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
    """Return the mean over scenes of a recipe's values by seed; an empty cell if a scene has no value."""
    if not numbers or not all(known(seeds) for seeds in numbers):
        return Cell()
    complete = [fmean(seeds) for seeds in np.transpose(numbers).tolist() if not np.isnan(seeds).any()]
    return replace(cell_of(complete), mean=fmean(fmean(known(seeds)) for seeds in numbers))


def _frame(rows: list[Any], names: Sequence[str], numbers: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=[*names, *numbers]).astype(dict.fromkeys(numbers, float))


def _with_spreads(columns: Sequence[Metric]) -> list[str]:
    return [name for column in columns for name in (column.key, f"{column.key}_spread")]


def _numbers(cells: Iterable[Cell]) -> Iterator[float | None]:
    """Return the mean and the spread of each cell in turn."""
    return (value for cell in cells for value in (cell.mean, cell.spread))
