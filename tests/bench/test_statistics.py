"""Paired differences, their intervals and what is noise: against scipy, by simulation, and the docs' page on them."""

import random
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from comparison_records import results, run, unfinished
from markdown_tables import page_table, tables_of
from scipy import stats

from polarguide_bench.results import (
    KNOWN_SCATTER,
    Results,
    controlled,
    estimate,
    is_noise,
    paired,
    shared,
    t_half_width,
    training_noise,
)
from polarguide_bench.tables import scores_section

NAN = float("nan")
FREE, LOOSE = "r:unpolarized", "r:unpolarized-without-consistency"
T_95 = {2: 4.302653, 3: 3.182446, 5: 2.570582}
"""Student's quantiles at 97.5 %, from a printed table, by degrees of freedom."""
ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks" / "accuracy"))
import seed_scatter  # noqa: E402

PAGE = ROOT / "docs" / "explanation" / "statistics.md"
PAGE_NAME = "explanation/statistics"


def trained(scene: str, recipe: str, seed: int, views: dict[str, float], key: str = "psnr") -> dict[str, Any]:
    """Return a finished run with a metric by view."""
    made = run(scene, recipe, seed, **{key: float(np.mean(list(views.values())))})
    return made | {"views": {view: {key: value} for view, value in views.items()}}


def one(found: Results, **wanted: Any) -> pd.Series:
    """Return the only difference with these values. The scene of a difference over scenes is "all"."""
    frame = found.differences.fillna({"scene": "all"})
    for key, value in wanted.items():
        frame = frame[frame[key] == value]
    assert len(frame) == 1
    return frame.iloc[0]


@pytest.mark.parametrize("count", [3, 4, 6])
def test_the_interval_is_students(count: int) -> None:
    values = np.random.default_rng(count).normal(2.0, 0.5, count)
    expected = T_95[count - 1] * values.std(ddof=1) / np.sqrt(count)
    assert t_half_width(list(values)) == pytest.approx(expected, rel=1e-6)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert t_half_width(list(values)) == pytest.approx((high - low) / 2, rel=1e-9)
    assert t_half_width([1.0] * count) == 0.0


@pytest.mark.parametrize(
    ("scenes", "seeds", "over", "count"),
    [(1, 3, "seeds", 3), (1, 2, "views", 6), (2, 3, "seeds", 3), (4, 1, "scenes", 4), (2, 1, None, 0)],
)
def test_the_unit_is_the_scene_else_the_seed_else_the_view(
    scenes: int, seeds: int, over: str | None, count: int
) -> None:
    values = np.random.default_rng(scenes).normal(1, 3, (scenes, seeds, 6))
    found = estimate(list(values), None)
    assert (found["over"], found["count"], found["seeds"]) == (over, count, seeds)
    assert found["mean"] == pytest.approx(values.mean())
    axes = {"scenes": (1, 2), "seeds": (0, 2), "views": (0, 1)}
    if over is None:
        assert (found["low"], found["high"]) == (None, None)
    else:
        interval = stats.ttest_1samp(values.mean(axis=axes[over]), 0).confidence_interval(0.95)
        assert (found["low"], found["high"]) == pytest.approx((interval.low, interval.high))


def test_only_what_both_have_is_paired() -> None:
    of = np.array([[3.0, 4.0], [5.0, 9.0], [1.0, NAN], [NAN, NAN]])
    other = np.array([[1.0, 1.0], [2.0, NAN], [NAN, 7.0], [0.0, 0.0]])
    # The first two seeds are with both, and the second view not in all of these.
    np.testing.assert_array_equal(paired(of, other), [[2.0], [3.0], [NAN], [NAN]])
    assert paired(of[3:], other[3:]).size == 0
    # Seeds without a view that all have cannot be paired.
    apart = np.array([[1.0, NAN], [NAN, 1.0]])
    assert paired(apart, apart).size == 0
    assert shared(np.array([[[1.0], [NAN]], [[1.0], [1.0]], [[NAN], [1.0]]])).size == 0


def test_intervals_over_seeds_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(4)
    truth, trials, hits = 1.0, 1500, {"seeds": 0, "views": 0}
    for _ in range(trials):
        # A training's luck moves all of its views; each view has its own difficulty, which pairing takes out.
        d = truth + rng.normal(0, 0.2, (3, 1)) + rng.normal(0, 0.3, (3, 6))
        for over, values in (("seeds", d), ("views", d[:1])):
            found = estimate([values], None)
            assert found["over"] == over
            hits[over] += found["low"] <= truth <= found["high"]
    assert 0.93 < hits["seeds"] / trials < 0.97
    assert hits["views"] / trials < 0.9, "an interval over views leaves out the luck of the training"


def test_noise_is_that_of_three_seeds_else_the_known_scatter() -> None:
    values = np.random.default_rng(0).normal(0.1, 0.2, 4)
    half = stats.ttest_1samp(values, 0).confidence_interval().high - values.mean()
    assert training_noise(values[None], 99.0) == pytest.approx(half)
    assert training_noise(np.array([[1.0]]), 0.2) == pytest.approx(1.959964 * 0.2)
    assert training_noise(np.array([[1.0, 5.0]]), 0.2) == pytest.approx(1.959964 * 0.2 / 2**0.5)
    # Two scenes, of one and two seeds: the variance of the mean of their means.
    two = training_noise(np.array([[1.0, NAN], [1.0, 2.0]]), 0.2)
    assert two == pytest.approx(1.959964 * (0.2**2 / 4 + 0.2**2 / 2 / 4) ** 0.5)
    assert training_noise(np.array([[1.0, 2.0]]), None) is None
    assert is_noise(np.array([[1.0]]), None) is None


def test_controls_are_known_by_their_names() -> None:
    names = ["r", FREE, LOOSE, "r:without-normals", "s", "s:unpolarizedly", "t:kind", "t:kind:unpolarized"]
    assert controlled(names) == {"r": [FREE, LOOSE], "t:kind": ["t:kind:unpolarized"]}


def test_the_better_control_is_taken_metric_by_metric() -> None:
    table = {"r": (33.0, 6.0), FREE: (31.0, 9.0), LOOSE: (32.0, 14.0)}
    found = results([run("x", name, 0, psnr=p, normal_mae_deg=n) for name, (p, n) in table.items()])
    assert one(found, metric="psnr")[["other", "mean"]].tolist() == [LOOSE, 1.0]
    assert one(found, metric="normal_mae_deg")[["other", "mean", "why"]].tolist() == [FREE, -3.0, "control"]


def test_the_choice_rests_on_seeds_that_all_have_and_the_difference_on_those_of_the_pair() -> None:
    runs = [run("x", "r", seed, psnr=30.0 + seed) for seed in range(3)]
    runs += [run("x", FREE, seed, psnr=28.0 + 2 * seed) for seed in range(3)]  # in the mean 30
    better = one(results([*runs, run("x", LOOSE, 0, psnr=28.5)]))  # where both are, at seed 0
    assert better[["other", "mean", "seeds"]].tolist() == [LOOSE, 1.5, 1]
    worse = one(results([*runs, run("x", LOOSE, 0, psnr=27.5)]))
    assert worse[["other", "mean", "seeds", "over", "count", "noise"]].tolist() == [
        FREE,
        1.0,
        3,
        "seeds",
        3,
        True,
    ]
    # Controls without a common seed are not chosen from.
    runs = [run("x", "r", seed, psnr=33.0) for seed in (0, 1)]
    runs += [run("x", FREE, 0, psnr=31.0), run("x", LOOSE, 1, psnr=32.0)]
    assert results(runs).differences.empty


def test_against_scipy_with_three_seeds_and_views_that_are_missing() -> None:
    rng = np.random.default_rng(5)
    values = {name: rng.normal(mean, 0.3, (3, 6)) for name, mean in (("r", 32.0), (FREE, 31.0))}
    runs = [
        trained("x", name, seed, {f"v{k}": float(v) for k, v in enumerate(row)})
        for name, rows in values.items()
        for seed, row in enumerate(rows)
    ]
    runs[4]["views"]["v2"]["psnr"] = None  # of the control, seed 1: pairs leave the view out
    of, other = (values[name][:, [0, 1, 3, 4, 5]].mean(axis=1) for name in ("r", FREE))
    expected = stats.ttest_rel(of, other).confidence_interval(0.95)
    random.Random(0).shuffle(runs)
    for order in (runs, sorted(runs, key=lambda item: item["recipe"])):
        found = one(results(order), metric="psnr", why="control")
        assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high))
        assert found[["over", "count", "noise"]].tolist() == ["seeds", 3, False]


def test_with_one_seed_noise_is_judged_by_the_known_scatter() -> None:
    views = {"v0": 30.0, "v1": 34.0, "v2": 28.0, "v3": 31.0}
    better = {view: value + 0.3 for view, value in views.items()}
    found = one(results([trained("x", "r", 0, better), trained("x", FREE, 0, views)]), metric="psnr")
    assert (found["mean"], found["low"], found["high"]) == pytest.approx(
        (0.3, 0.3, 0.3)
    )  # the same on every view
    assert found[["over", "count", "noise"]].tolist() == ["views", 4, True]
    levels = {
        name: {f"v{k}": level + 0.01 * k * k for k in range(4)} for name, level in (("r", 0.1), (FREE, 0.2))
    }
    found = one(results([trained("x", name, 0, of, "lpips") for name, of in levels.items()]), metric="lpips")
    assert found["noise"] is None, "no scatter is known of it"


def test_over_scenes_one_control_is_taken_and_the_scene_is_the_unit() -> None:
    table = {"x": (33.0, 32.0, 30.0), "y": (34.0, 30.0, 31.0), "z": (31.0, 31.5, 29.0)}
    runs = [
        run(scene, name, 0, psnr=value)
        for scene, row in table.items()
        for name, value in zip(("r", FREE, LOOSE), row, strict=True)
    ]
    found = results(runs)
    assert [one(found, scene=s)["other"] for s in "xyz"] == [FREE, LOOSE, FREE]
    over = one(found, scene="all")
    expected = stats.ttest_1samp([1.0, 4.0, -0.5], 0).confidence_interval(0.95)
    assert (over["low"], over["high"]) == pytest.approx((expected.low, expected.high))
    assert over[["other", "over", "count", "noise"]].tolist() == [FREE, "scenes", 3, True]


def test_what_has_not_finished_is_never_paired() -> None:
    runs = [run("x", "r", 0, psnr=33.0), unfinished("x", FREE, 0, "disk full"), run("x", LOOSE, 0, psnr=31.0)]
    runs += [run("y", "r", 0, psnr=33.0), unfinished("y", FREE, 0), unfinished("y", LOOSE, 0)]
    runs += [run("y", LOOSE, 1, psnr=20.0)]  # of another seed
    (found,) = results(runs).compared
    assert (found["scene"], found["other"], found["left_out"]) == ("x", LOOSE, [FREE])


def test_differences_are_to_a_recipe_that_was_asked_for_and_of_no_seconds_or_counts() -> None:
    values = {"gaussians": 10.0, "fps": 5.0, "train_seconds": 3.0}
    runs = [run("x", name, 0, psnr=v, **values) for name, v in (("3dgs", 30.0), ("s", 29.5), ("t", 30.2))]
    found = results(runs, against="3dgs").differences
    assert found[["recipe", "other", "why", "metric"]].to_numpy().tolist() == [
        ["s", "3dgs", "against", "psnr"],
        ["t", "3dgs", "against", "psnr"],
    ]
    assert results(runs).differences.empty


def leading(key: str, table: dict[str, dict[int, float]]) -> set[str]:
    """Return the leading recipes of a column from values by recipe and seed on one scene."""
    runs = [run("cup", recipe, seed, **{key: v}) for recipe, by in table.items() for seed, v in by.items()]
    ((_, rows),) = scores_section(results(runs)).blocks
    return {labels[0][0] for labels, cells in rows if cells[0][2]}


LUCK = (0.0, 2.0, 4.0)
SCATTER = KNOWN_SCATTER["psnr"]


@pytest.mark.parametrize(
    ("key", "table", "best"),
    [
        # Rows within noise of the best share its mark.
        ("psnr", {"best": {0: 31.0}, "near": {0: 31.0 - 1.9 * SCATTER}}, set()),
        (
            "psnr",
            {"best": {0: 31.0}, "near": {0: 31.0 - 1.9 * SCATTER}, "far": {0: 31.0 - 2 * SCATTER}},
            {"best", "near"},
        ),
        # Pairing tells what spreads would not: always behind, and as far behind, but not always.
        (
            "psnr",
            {
                "best": {s: 30.0 + x for s, x in enumerate(LUCK)},
                "behind": {s: 29.7 + x + 0.01 * s for s, x in enumerate(LUCK)},
                "wild": {s: 29.7 + x for s, x in enumerate((4.0, 0.0, 2.0))},
            },
            {"best", "wild"},
        ),
        # Rows of unequal seeds are paired where they meet, and not at all without a common one.
        ("psnr", {"best": {0: 30.0, 1: 33.0, 2: 33.0}, "one": {0: 30.0}}, set()),
        ("psnr", {"best": {0: 30.0, 1: 33.0, 2: 33.0}, "one": {0: 29.0}}, {"best"}),
        ("psnr", {"best": {0: 30.0, 1: 33.0, 2: 33.0}, "apart": {9: 31.9}}, set()),
        # With an unknown scatter, fewer than three seeds decide nothing, however far apart they are.
        ("lpips", {"a": {0: 0.100}, "b": {0: 0.102}, "c": {0: 0.1001}}, set()),
        ("lpips", {"a": {0: 0.2, 1: 0.2}, "b": {0: 0.4, 1: 0.6}, "c": {0: 0.3, 1: 0.3}}, set()),
        (
            "lpips",
            {
                "a": dict.fromkeys(range(3), 0.2),
                "b": {0: 0.1, 1: 0.4, 2: 0.5},
                "c": {0: 0.3, 1: 0.31, 2: 0.3},
            },
            {"a", "b"},
        ),
        ("psnr", {"a": {0: 30.0}}, set()),  # nothing to be better than
        ("gaussians", {"a": {0: 1.0}, "b": {0: 2.0}}, set()),  # neither is better
    ],
)
def test_the_best_are_marked(key: str, table: dict[str, dict[int, float]], best: set[str]) -> None:
    assert leading(key, table) == best


def test_a_mean_over_scenes_scatters_less() -> None:
    runs = [run(s, r, 0, psnr=v) for s in "abcd" for r, v in (("best", 31.0), ("near", 30.7))]
    blocks = dict(scores_section(results(runs)).blocks)
    bold = {title: sum(cells[0][2] for _, cells in rows) for title, rows in blocks.items()}
    assert bold == {
        **dict.fromkeys("abcd", 0),
        "mean over scenes": 1,
    }  # below 1.96 times the scatter, but above half of it


def test_the_known_scatter_and_the_page_agree_with_the_records() -> None:
    records = sorted((ROOT / "benchmarks" / "results" / "final").glob("*/*.json"))
    pairs = seed_scatter.pairs_of_records(records)
    stated, pairing = page_table(PAGE_NAME, "metric", "unit"), page_table(PAGE_NAME, "remaining variance (%)")
    assert [stated] == tables_of(seed_scatter.scatter_table(pairs))
    assert [pairing] == tables_of(seed_scatter.pairing_table(pairs))
    assert f"{len(pairs)} pairs" in PAGE.read_text(encoding="utf-8")
    by_metric = {row["metric"].strip("`"): float(row["scatter"]) for row in stated}
    assert by_metric == KNOWN_SCATTER


def test_the_scatter_of_simulated_pairs() -> None:
    rng = np.random.default_rng(8)
    difficulty = rng.normal(0, 3, 40)
    pairs = []
    for _ in range(400):
        luck = rng.normal(0, 0.4, 3)  # shared by both recipes
        own = rng.normal(0, 0.2, (2, 3))
        both = [
            {
                seed: {
                    "metrics": {"psnr": 30 + luck[seed] + own[recipe, seed]},
                    "views": {
                        view: {"psnr": 30 + hard + rng.normal(0, 0.5)} for view, hard in enumerate(difficulty)
                    },
                }
                for seed in range(3)
            }
            for recipe in range(2)
        ]
        pairs.append(("scene", *both))
    scatter = seed_scatter.typical_scatter(pairs, "psnr")
    assert scatter == pytest.approx(0.2 * 2**0.5, rel=0.1)
    assert seed_scatter.beyond(pairs, "psnr", scatter) == pytest.approx(0.05, abs=0.015)
    assert seed_scatter.left_by_seeds(pairs, "psnr") == pytest.approx(0.04 / (0.04 + 0.16), rel=0.1)
    by_view = [share for pair in pairs for share in seed_scatter.left_by_views(pair, "psnr")]
    assert np.median(by_view) == pytest.approx(0.25 / (0.25 + difficulty.var(ddof=1)), rel=0.1)


def test_the_page_gives_the_power_of_seeds() -> None:
    text = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d\.?\d*) \| (\d+) \|$", text, re.MULTILINE)
    assert len(rows) >= 5
    for ratio, seeds in rows:
        assert power(float(ratio), int(seeds)) >= 0.8
        assert int(seeds) == 3 or power(float(ratio), int(seeds) - 1) < 0.8


def power(ratio: float, seeds: int) -> float:
    """Return the probability that an interval over seeds excludes 0, if the difference is ``ratio`` of its scatter."""
    shift, critical = ratio * seeds**0.5, stats.t.ppf(0.975, seeds - 1)
    beyond = stats.nct(seeds - 1, shift)
    return float(beyond.sf(critical) + beyond.cdf(-critical))
