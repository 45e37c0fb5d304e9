"""The runs of a comparison -> paired differences: of a recipe to the better of its controls, of every recipe to one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

from polarguide.evaluation.table import COLUMNS, Metric
from polarguide.experiments.aggregate import RunRecord
from polarguide.experiments.controls import controlled
from polarguide.experiments.intervals import (
    Estimate,
    Over,
    Samples,
    common,
    estimate,
    mean,
    paired,
    seed_means,
)
from polarguide.experiments.noise import is_noise, known_scatter

Why = Literal["control", "against"]
COMPARED = tuple(column for column in COLUMNS if column.better is not None and not column.timed)
"""The metrics of which differences are taken: those that have a better side and do not depend on the machine."""


class Difference(TypedDict):
    """How far a recipe is from another in one metric, on one scene or (``scene`` None) over all of them.

    ``why`` is "control" for the better of the recipe's controls, and "against" for the recipe that was asked for.
    ``mean`` is recipe - other; ``low`` and ``high`` enclose it with 95 % confidence over ``count`` seeds, views or
    scenes (``over``), and all are None or 0 where these are fewer than three. ``seeds`` are paired. ``noise`` says
    whether the difference may be none; None: not known. ``left_out`` are controls without the runs to be chosen.
    """

    scene: str | None
    recipe: str
    other: str
    why: Why
    metric: str
    mean: float
    low: float | None
    high: float | None
    over: Over | None
    count: int
    seeds: int
    noise: bool | None
    left_out: list[str]


@dataclass(frozen=True)
class Pairing:
    """A recipe beside one of several others: which one, its differences by scene, and which had no runs to pair."""

    other: str
    by_scene: dict[str, dict[int, dict[str, float]]]
    left_out: list[str]


def differences(
    runs: Sequence[RunRecord],
    scenes: Mapping[str, float | None],
    recipes: Sequence[str],
    against: str | None,
) -> list[Difference]:
    """All differences that finished runs give, scene by scene, then over scenes.

    Over scenes there is one only where both recipes have runs to pair on every scene on which any recipe has a value.

    Args:
        runs: in any order.
        scenes: names in the order wanted, with the share of black pixels (None: not known).
        recipes: names in the order wanted.
        against: the recipe that all others are compared with, or None.
    """
    data = {column.key: samples_of(runs, column) for column in COMPARED}
    wanted: list[tuple[Why, str, list[str]]] = [("control", r, c) for r, c in controlled(recipes).items()]
    if against is not None:
        wanted += [("against", recipe, [against]) for recipe in recipes if recipe != against]
    found = []
    for scene in [*scenes, *([None] if len(scenes) > 1 else [])]:
        for why, recipe, others in wanted:
            for column in COMPARED:
                of = data[column.key]
                places = [scene] if scene is not None else [name for name in scenes if of.get(name)]
                pairing = pair({name: of.get(name, {}) for name in places}, recipe, others, column)
                if pairing is not None:
                    found.append(_difference(pairing, scene, recipe, why, column.key, scenes))
    return found


def samples_of(runs: Sequence[RunRecord], column: Metric) -> dict[str, dict[str, Samples]]:
    """A metric by scene, recipe, seed and view; one that is not of views has the empty name in place of a view."""
    found: dict[str, dict[str, dict[int, Mapping[str, float]]]] = {}
    for run in runs:
        values = dict(_values(run, column))
        if values:
            found.setdefault(run["scene"], {}).setdefault(run["recipe"], {})[run["seed"]] = values
    return {scene: dict(by_recipe) for scene, by_recipe in found.items()}


def _values(run: RunRecord, column: Metric) -> Iterator[tuple[str, float]]:
    if column.of == "run":
        value = (run["metrics"] or {}).get(column.key)
        if value is not None:
            yield "", value
        return
    for view, scores in run["views"].items():
        value = scores.get(column.key)
        if value is not None:
            yield view, value


def pair(
    data: Mapping[str, Mapping[str, Samples]], recipe: str, others: Sequence[str], column: Metric
) -> Pairing | None:
    """A recipe beside the better of others, by their means over the seeds and views that all of them have.

    Args:
        data: by scene and recipe; all these scenes count.
        recipe: the recipe. others: what to choose from; the first of equal ones is taken.
        column: the metric, which has a better side.

    Returns:
        None where there is nothing to pair, or nothing that all have and the choice could rest on.
    """
    pairs = {
        other: {s: paired(by.get(recipe, {}), by.get(other, {})) for s, by in data.items()}
        for other in others
    }
    whole = [other for other in others if data and all(pairs[other].values())]
    chosen = whole[0] if len(whole) == 1 else _better(data, recipe, whole, column)
    left_out = [other for other in others if other not in whole]
    return None if chosen is None else Pairing(chosen, pairs[chosen], left_out)


def _better(
    data: Mapping[str, Mapping[str, Samples]], recipe: str, others: Sequence[str], column: Metric
) -> str | None:
    shared = {scene: common([by[name] for name in (recipe, *others)]) for scene, by in data.items() if others}
    if not shared or not all(shared.values()):
        return None

    def level(other: str) -> float:
        values = (
            mean(data[scene][other][seed][view] for seed, views in places.items() for view in views)
            for scene, places in shared.items()
        )
        return mean(values)

    return max(others, key=level) if column.better == "higher" else min(others, key=level)


def judged(
    by_scene: Mapping[str, Samples], scatter: Mapping[str, float | None]
) -> tuple[Estimate, bool | None]:
    """The mean of paired differences by scene, and whether it may be noise; None: not known.

    It may be if its interval holds 0, and, where this is not over seeds or scenes, if another seed may turn it.

    Args:
        by_scene: what ``paired`` gives. scatter: the known scatter by scene.
    """
    found = estimate(by_scene)
    holds_zero = found.half is not None and abs(found.mean) <= found.half
    if holds_zero or found.over in ("seeds", "scenes"):
        return found, holds_zero
    return found, is_noise({scene: seed_means(samples) for scene, samples in by_scene.items()}, scatter)


def _difference(
    pairing: Pairing,
    scene: str | None,
    recipe: str,
    why: Why,
    key: str,
    scenes: Mapping[str, float | None],
) -> Difference:
    found, noise = judged(pairing.by_scene, {s: known_scatter(key, scenes[s]) for s in pairing.by_scene})
    low, high = (None, None) if found.half is None else (found.mean - found.half, found.mean + found.half)
    return Difference(
        scene=scene,
        recipe=recipe,
        other=pairing.other,
        why=why,
        metric=key,
        mean=found.mean,
        low=low,
        high=high,
        over=found.over,
        count=found.count,
        seeds=found.seeds,
        noise=noise,
        left_out=pairing.left_out,
    )
