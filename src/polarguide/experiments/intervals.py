"""Paired differences between two recipes, and how sure they are.

``docs/explanation/statistics.md`` gives the formulas and says what each interval is over.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from scipy import stats

Samples = Mapping[int, Mapping[str, float]]
"""A metric of one recipe on one scene, by seed and test view."""
Over = Literal["seeds", "views", "scenes"]

CONFIDENCE = 0.95
LEAST_UNITS = 3
"""Fewest seeds, views or scenes of which an interval is given: with two, it is 13 times as wide as they are apart."""
NORMAL_QUANTILE = float(stats.norm.ppf((1 + CONFIDENCE) / 2))


@dataclass(frozen=True)
class Estimate:
    """A mean difference with its 95 % confidence interval.

    Attributes:
        mean: the difference. half: half the width of the interval; None where there are too few to give one.
        over: of what the interval is the scatter; None where there is no interval. count: how many of these.
        seeds: how many seeds are paired (of several scenes: on the one with the fewest).
    """

    mean: float
    half: float | None
    over: Over | None
    count: int
    seeds: int


def t_half_width(values: Sequence[float]) -> float:
    """Half the width of Student's 95 % confidence interval of the mean of two or more independent values."""
    error = statistics.stdev(values) / math.sqrt(len(values))
    return float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1)) * error


def paired(of: Samples, other: Samples) -> dict[int, dict[str, float]]:
    """Differences ``of - other`` by seed and view, of the seeds and views that both have.

    Only views that every paired seed has are taken, so that all seeds are means over the same views.
    """
    shared = common([of, other])
    return {
        seed: {view: of[seed][view] - other[seed][view] for view in views} for seed, views in shared.items()
    }


def common(all_samples: Sequence[Samples]) -> dict[int, list[str]]:
    """The seeds that all have with at least one common view, each with the views that all have with all these seeds."""
    first, *others = all_samples
    shared = {
        seed: [view for view in views if all(view in other.get(seed, ()) for other in others)]
        for seed, views in first.items()
    }
    shared = {seed: views for seed, views in shared.items() if views}
    everywhere = [view for view in next(iter(shared.values()), []) if all(view in v for v in shared.values())]
    return {seed: everywhere for seed in shared} if everywhere else {}


def mean(values: Iterable[float]) -> float:
    """Arithmetic mean."""
    numbers = list(values)
    return math.fsum(numbers) / len(numbers)


def seed_means(samples: Samples) -> dict[int, float]:
    """Means over views by seed."""
    return {seed: mean(views.values()) for seed, views in samples.items()}


def estimate(differences: Mapping[str, Samples]) -> Estimate:
    """The mean of paired differences, and how sure it is.

    The interval is over scenes if there are at least three; else over seeds, if at least three are paired on every
    scene; else, of one scene, over its test views: this one holds for these trainings only.

    Args:
        differences: by scene, what ``paired`` gives, not empty.
    """
    by_scene = {scene: seed_means(samples) for scene, samples in differences.items()}
    means = [mean(by_seed.values()) for by_seed in by_scene.values()]
    seeds = min(len(by_seed) for by_seed in by_scene.values())
    units: list[tuple[Over, list[float]]] = [
        ("scenes", means if len(means) > 1 else []),
        ("seeds", means_by_seed(by_scene)),
        ("views", _view_means(next(iter(differences.values()))) if len(means) == 1 else []),
    ]
    for over, values in units:
        if len(values) >= LEAST_UNITS:
            return Estimate(mean(means), t_half_width(values), over, len(values), seeds)
    return Estimate(mean(means), None, None, 0, seeds)


def means_by_seed(by_scene: Mapping[str, Mapping[int, float]]) -> list[float]:
    """The mean over scenes of every seed that all scenes have."""
    first, *others = by_scene.values()
    seeds = [seed for seed in first if all(seed in other for other in others)]
    return [mean(by_seed[seed] for by_seed in by_scene.values()) for seed in seeds]


def _view_means(samples: Samples) -> list[float]:
    """Means over seeds by view."""
    first = next(iter(samples.values()))
    return [mean(by_view[view] for by_view in samples.values()) for view in first]
