"""Paired means and their intervals against numpy, bootstrap-free: by the textbook's formula and by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from polarguide.experiments.intervals import common, estimate, paired, t_half_width

T_95 = {2: 4.302653, 3: 3.182446, 5: 2.570582}
"""Student's quantiles at 97.5 %, from a printed table, by degrees of freedom."""


def samples(values: np.ndarray) -> dict[int, dict[str, float]]:
    """Values [seeds, views] as samples."""
    return {
        seed: {f"v{view}": float(value) for view, value in enumerate(row)} for seed, row in enumerate(values)
    }


@pytest.mark.parametrize("count", [3, 4, 6])
def test_the_interval_is_students(count: int) -> None:
    values = np.random.default_rng(count).normal(2.0, 0.5, count)
    expected = T_95[count - 1] * values.std(ddof=1) / np.sqrt(count)
    assert t_half_width(list(values)) == pytest.approx(expected, rel=1e-6)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert t_half_width(list(values)) == pytest.approx((high - low) / 2, rel=1e-9)


def test_equal_values_have_an_interval_without_width() -> None:
    assert t_half_width([1.0, 1.0, 1.0]) == 0.0


def test_with_three_seeds_the_seed_is_the_unit() -> None:
    rng = np.random.default_rng(0)
    of, other = rng.normal(30, 3, (3, 8)), rng.normal(29, 3, (3, 8))
    found = estimate({"x": paired(samples(of), samples(other))})
    by_seed = (of - other).mean(axis=1)
    assert found.mean == pytest.approx(by_seed.mean())
    assert found.half == pytest.approx(T_95[2] * by_seed.std(ddof=1) / np.sqrt(3), rel=1e-6)
    assert (found.over, found.count, found.seeds) == ("seeds", 3, 3)
    assert stats.ttest_rel(of.mean(axis=1), other.mean(axis=1)).confidence_interval().high == pytest.approx(
        found.mean + found.half
    )


def test_with_fewer_seeds_it_is_the_view() -> None:
    rng = np.random.default_rng(1)
    of, other = rng.normal(30, 3, (2, 6)), rng.normal(29, 3, (2, 6))
    found = estimate({"x": paired(samples(of), samples(other))})
    by_view = (of - other).mean(axis=0)
    assert (found.over, found.count, found.seeds) == ("views", 6, 2)
    assert found.half == pytest.approx(T_95[5] * by_view.std(ddof=1) / np.sqrt(6), rel=1e-6)


def test_two_views_of_one_seed_give_no_interval() -> None:
    found = estimate({"x": paired(samples(np.array([[3.0, 5.0]])), samples(np.array([[1.0, 1.0]])))})
    assert (found.mean, found.half, found.over, found.count) == (3.0, None, None, 0)


def test_over_scenes_the_scene_is_the_unit() -> None:
    rng = np.random.default_rng(2)
    by_scene = {f"s{k}": rng.normal(k, 1, (1 + k % 2, 4)) for k in range(4)}  # one or two seeds
    found = estimate({scene: samples(d) for scene, d in by_scene.items()})
    means = np.array([d.mean() for d in by_scene.values()])
    assert found.mean == pytest.approx(means.mean())
    assert found.half == pytest.approx(T_95[3] * means.std(ddof=1) / 2, rel=1e-6)
    assert (found.over, found.count, found.seeds) == ("scenes", 4, 1)


def test_over_two_scenes_it_is_the_seed_again() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.normal(1, 1, (3, 4)), rng.normal(5, 1, (3, 4))
    found = estimate({"a": samples(first), "b": samples(second)})
    by_seed = (first.mean(axis=1) + second.mean(axis=1)) / 2
    assert found.over == "seeds"
    assert found.mean == pytest.approx(by_seed.mean())
    assert found.half == pytest.approx(T_95[2] * by_seed.std(ddof=1) / np.sqrt(3), rel=1e-6)


def test_only_what_both_have_is_paired() -> None:
    of = {0: {"a": 3.0, "b": 4.0}, 1: {"a": 5.0, "b": 9.0}, 7: {"a": 1.0}}
    other = {0: {"a": 1.0, "b": 1.0, "c": 9.0}, 1: {"a": 2.0}, 2: {"a": 0.0}}
    # Seeds 0 and 1 are with both, and view b not in all of these.
    assert paired(of, other) == {0: {"a": 2.0}, 1: {"a": 3.0}}
    assert paired(of, {0: {"c": 1.0}}) == {}
    assert paired({}, other) == {}
    assert common([{0: {"a": 1.0}}, {0: {"a": 1.0}, 1: {"a": 1.0}}, {1: {"a": 1.0}}]) == {}


def test_seeds_without_a_view_that_all_have_cannot_be_paired() -> None:
    apart = {0: {"a": 1.0}, 1: {"b": 1.0}}
    assert paired(apart, apart) == {}


def test_intervals_over_seeds_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(4)
    truth, hits, views_hit, trials = 1.0, 0, 0, 1500
    for _ in range(trials):
        # A training's luck moves all of its views; each view has its own difficulty, which pairing takes out.
        d = truth + rng.normal(0, 0.2, (3, 1)) + rng.normal(0, 0.3, (3, 6))
        by_seed, by_view = estimate({"x": samples(d)}), estimate({"x": samples(d[:1])})
        assert by_seed.half is not None
        assert by_view.half is not None
        hits += abs(by_seed.mean - truth) <= by_seed.half
        views_hit += abs(by_view.mean - truth) <= by_view.half
    assert 0.93 < hits / trials < 0.97
    assert views_hit / trials < 0.9, "an interval over views leaves out the luck of the training"
