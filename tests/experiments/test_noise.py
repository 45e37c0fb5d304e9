"""Which differences are noise: the marks of the tables, and the numbers on the docs' page on statistics."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from comparison_records import results, run
from scipy import stats

from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.noise import KNOWN_SCATTER, is_noise, known_scatter, training_noise
from polarguide.experiments.tables import leading_rows

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "statistics.md"
RECORDS = ("ablation-polarguide", "ablation-polarguide-stokes")
AUDITED = {"psnr": 0.23, "psnr_foreground": 0.10, "normal_mae_deg": 0.46} | dict.fromkeys(
    ("specular_psnr", "diffuse_psnr", "specular_psnr_aligned", "diffuse_psnr_aligned"), 0.28
)
"""Upper ends of what the page quotes beside the records."""
BY_KEY = {column.key: column for column in COLUMNS}


def leading(key: str, table: dict[str, dict[int, float]], black: tuple[str, ...] = ()) -> set[str]:
    """The recipes that lead in a column, of values by recipe and seed on one scene."""
    runs = [run("cup", recipe, seed, **{key: v}) for recipe, by in table.items() for seed, v in by.items()]
    record = results(runs, black=black)
    return {record["table"][i]["recipe"] for i in leading_rows(record["table"], BY_KEY[key], record)}


def test_own_scatter_counts_from_three_seeds() -> None:
    rng = np.random.default_rng(0)
    by_seed = dict(enumerate(rng.normal(0.1, 0.2, 4)))
    expected = stats.ttest_1samp(list(by_seed.values()), 0).confidence_interval().high - np.mean(
        list(by_seed.values())
    )
    assert training_noise({"x": by_seed}, {"x": 99.0}) == pytest.approx(expected)


def test_known_scatter_counts_below() -> None:
    assert training_noise({"x": {0: 1.0}}, {"x": 0.2}) == pytest.approx(1.959964 * 0.2)
    assert training_noise({"x": {0: 1.0, 1: 5.0}}, {"x": 0.2}) == pytest.approx(1.959964 * 0.2 / 2**0.5)
    # Two scenes, of one and two seeds: the variance of the mean of their means.
    two = training_noise({"x": {0: 1.0}, "y": {0: 1.0, 1: 2.0}}, {"x": 0.2, "y": 0.4})
    assert two == pytest.approx(1.959964 * (0.2**2 / 4 + 0.4**2 / 2 / 4) ** 0.5)


def test_without_known_scatter_two_seeds_speak_for_themselves_and_one_does_not() -> None:
    assert training_noise({"x": {0: 1.0}}, {}) is None
    assert is_noise({"x": {0: 1.0}}, {}) is None
    assert training_noise({"x": {0: 1.0, 1: 2.0}}, {}) == pytest.approx(12.7062 * 0.5, rel=1e-5)
    assert training_noise({"x": {0: 1.0}, "y": {0: 1.0}}, {"x": 0.2}) is None


def test_what_is_not_told_from_the_best_shares_its_mark() -> None:
    table = {"best": {0: 31.0}, "near": {0: 30.6}, "far": {0: 30.5}}  # 1.96 times 0.23 is 0.45
    assert leading("psnr", table) == {"best", "near"}
    # The same on black, where a seed moves the picture by 1.5 dB.
    assert leading("psnr", table, black=("cup",)) == {"best", "near", "far"}
    assert leading("psnr_foreground", table, black=("cup",)) == {"best"}


def test_pairing_tells_what_spreads_would_not() -> None:
    luck = (0.0, 2.0, 4.0)
    table = {
        "best": {s: 30.0 + x for s, x in enumerate(luck)},
        "behind": {s: 29.7 + x + 0.01 * s for s, x in enumerate(luck)},  # always
        "wild": {s: 29.7 + x for s, x in enumerate((4.0, 0.0, 2.0))},  # as far behind, but not always
    }
    assert leading("psnr", table) == {"best", "wild"}


def test_rows_of_unequal_seeds_are_paired_where_they_meet() -> None:
    best = {0: 30.0, 1: 33.0, 2: 33.0}
    # Far behind in the mean, but at the one seed that both have no worse.
    assert leading("psnr", {"best": best, "one": {0: 30.0}}) == {"best", "one"}
    assert leading("psnr", {"best": best, "one": {0: 29.0}}) == {"best"}
    # No seed in common: nothing to pair, nothing to say.
    assert leading("psnr", {"best": best, "apart": {9: 31.9}}) == {"best"}


def test_a_metric_of_unknown_scatter_has_one_leader() -> None:
    assert leading("lpips", {"a": {0: 0.100}, "b": {0: 0.102}, "c": {0: 0.1001}}) == {"a", "c"}


def test_a_mean_over_scenes_scatters_less() -> None:
    assert known_scatter("psnr", None) == KNOWN_SCATTER["psnr"]
    runs = [run(s, r, 0, psnr=v) for s in "abcd" for r, v in (("best", 31.0), ("near", 30.7))]
    record = results(runs)
    rows = {scene: [row for row in record["table"] if row["scene"] == scene] for scene in ("a", None)}
    assert len(leading_rows(rows["a"], BY_KEY["psnr"], record)) == 2
    assert len(leading_rows(rows[None], BY_KEY["psnr"], record)) == 1  # 1.96 times 0.23 / 2 is 0.23


def test_the_known_scatter_is_that_of_the_records_on_file() -> None:
    scatters: dict[str, list[float]] = {}
    for name in RECORDS:
        record = json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())
        scores = {(r["scene"], r["recipe"], r["seed"]): r["metrics"] for r in record["runs"]}
        scenes, recipes = ([item["name"] for item in record[key]] for key in ("scenes", "recipes"))
        for scene, (a, b), key in itertools.product(
            scenes, itertools.combinations(recipes, 2), KNOWN_SCATTER
        ):
            pairs = [(scores[scene, a, seed][key], scores[scene, b, seed][key]) for seed in range(3)]
            if None not in itertools.chain(*pairs):
                scatters.setdefault(key, []).append(float(np.std([x - y for x, y in pairs], ddof=1)))
    median_of_sample = np.sqrt(stats.chi2(2).median() / 2)  # of a standard deviation of three, which is 1
    for key, known in KNOWN_SCATTER.items():
        recorded = float(np.median(scatters[key]) / median_of_sample)
        assert known == pytest.approx(max(recorded, AUDITED.get(key, 0.0)), rel=0.02), key


def test_the_page_gives_the_known_scatter_and_the_power_of_seeds() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for key, known in KNOWN_SCATTER.items():
        assert re.search(rf"\| `{key}`[^|]*\|[^|]*\| {known:g} \|", text), key
    rows = re.findall(r"^\| (\d\.?\d*) \| (\d+) \|$", text, re.MULTILINE)
    assert len(rows) >= 5
    for ratio, seeds in rows:
        assert power(float(ratio), int(seeds)) >= 0.8
        assert int(seeds) == 3 or power(float(ratio), int(seeds) - 1) < 0.8


def power(ratio: float, seeds: int) -> float:
    """The chance that an interval over seeds leaves out 0, if the difference is ``ratio`` of its scatter."""
    shift, critical = ratio * seeds**0.5, stats.t.ppf(0.975, seeds - 1)
    beyond = stats.nct(seeds - 1, shift)
    return float(beyond.sf(critical) + beyond.cdf(-critical))
