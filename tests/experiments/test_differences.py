"""What polarization buys: which control is taken, what is paired, and how tables show it."""

from __future__ import annotations

import csv
import io
import random
from typing import Any

import numpy as np
import pytest
from comparison_records import results, run, unfinished
from scipy import stats

from polarguide.experiments.controls import controlled
from polarguide.experiments.difference_tables import against_section, control_section
from polarguide.experiments.forms import differences_csv, latex, markdown
from polarguide.experiments.shown import Section

FREE, LOOSE = "r:unpolarized", "r:unpolarized-without-consistency"


def trained(scene: str, recipe: str, seed: int, views: dict[str, float], key: str = "psnr") -> dict[str, Any]:
    """A finished run with a metric by view."""
    made = run(scene, recipe, seed, **{key: float(np.mean(list(views.values())))})
    return made | {"views": {view: {key: value} for view, value in views.items()}}


def one(record: dict[str, Any], **wanted: Any) -> dict[str, Any]:
    """The only difference with these values."""
    (found,) = [d for d in record["differences"] if all(d[key] == value for key, value in wanted.items())]
    return dict(found)


def cells(section: Section | None, label: str, block: int = 0) -> list[str]:
    """The shown cells of a row."""
    assert section is not None
    (row,) = [row for row in section.blocks[block].rows if row.labels[0].text == label]
    return [" ".join(filter(None, ("*" * cell.bold + cell.value, cell.more))) for cell in row.cells]


def test_controls_are_known_by_their_names() -> None:
    names = ["r", FREE, LOOSE, "r:without-normals", "s", "s:unpolarizedly", "t:kind", "t:kind:unpolarized"]
    assert controlled(names) == {"r": [FREE, LOOSE], "t:kind": ["t:kind:unpolarized"]}


def test_the_better_control_is_taken_metric_by_metric() -> None:
    table = {"r": (33.0, 6.0), FREE: (31.0, 9.0), LOOSE: (32.0, 14.0)}
    record = results([run("x", name, 0, psnr=p, normal_mae_deg=n) for name, (p, n) in table.items()])
    assert (one(record, metric="psnr")["other"], one(record, metric="psnr")["mean"]) == (LOOSE, 1.0)
    found = one(record, metric="normal_mae_deg")
    assert (found["other"], found["mean"], found["why"], found["left_out"]) == (FREE, -3.0, "control", [])
    section = control_section(record)
    assert cells(section, "x") == ["*+1.00 b", "*−3.0 a"]  # noqa: RUF001
    assert section is not None
    assert section.headings == ("PSNR (dB) ↑", "normal error (deg) ↓")
    assert any(FREE in note and LOOSE in note for note in section.notes)


def test_the_choice_rests_on_seeds_that_all_have_and_the_difference_on_those_of_the_pair() -> None:
    runs = [run("x", "r", seed, psnr=30.0 + seed) for seed in range(3)]
    runs += [run("x", FREE, seed, psnr=28.0 + 2 * seed) for seed in range(3)]  # in the mean 30
    runs.append(run("x", LOOSE, 0, psnr=28.5))  # better where both are, at seed 0
    found = one(results(runs), metric="psnr")
    assert (found["other"], found["mean"], found["seeds"]) == (LOOSE, 1.5, 1)
    runs[-1] = run("x", LOOSE, 0, psnr=27.5)
    found = one(results(runs), metric="psnr")
    assert (found["other"], found["seeds"], found["over"], found["count"]) == (FREE, 3, "seeds", 3)
    assert found["mean"] == pytest.approx(np.mean([2.0, 1.0, 0.0]))
    assert found["noise"] is True


def test_against_scipy_with_three_seeds_and_views_that_are_missing() -> None:
    rng = np.random.default_rng(5)
    level = {"r": 32.0, FREE: 31.0}
    values = {name: rng.normal(mean, 0.3, (3, 6)) for name, mean in level.items()}
    runs = [
        trained("x", name, seed, {f"v{k}": float(v) for k, v in enumerate(row)})
        for name, rows in values.items()
        for seed, row in enumerate(rows)
    ]
    runs[4]["views"]["v2"]["psnr"] = None  # of the control, seed 1: pairs leave the view out
    keep = [0, 1, 3, 4, 5]
    of, other = (values[name][:, keep].mean(axis=1) for name in ("r", FREE))
    expected = stats.ttest_rel(of, other).confidence_interval(0.95)
    random.Random(0).shuffle(runs)
    ordered = sorted(runs, key=lambda item: item["recipe"])
    for record in (results(runs), results(ordered)):
        found = one(record, metric="psnr", why="control")
        assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high))
        assert (found["over"], found["count"], found["noise"]) == ("seeds", 3, False)


def test_with_one_seed_the_interval_is_over_views_and_noise_is_judged_by_the_known_scatter() -> None:
    views = {"v0": 30.0, "v1": 34.0, "v2": 28.0, "v3": 31.0}
    better = {view: value + 0.3 for view, value in views.items()}
    record = results([trained("x", "r", 0, better), trained("x", FREE, 0, views)])
    found = one(record, metric="psnr")
    assert found["mean"] == pytest.approx(0.3)
    assert (found["low"], found["high"]) == pytest.approx((0.3, 0.3))  # the same on every view
    assert (found["over"], found["count"], found["noise"]) == ("views", 4, True)  # 1.96 times 0.23 is 0.45
    assert cells(control_section(record), "x") == ["≈ +0.30 [+0.30, +0.30]"]
    section = control_section(record)
    assert section is not None
    assert section.blocks[0].rows[0].labels[1].text == "4 views of 1 seed"


def test_a_metric_of_unknown_scatter_is_marked_so() -> None:
    runs = [
        trained("x", name, 0, {f"v{k}": level + 0.01 * k * k for k in range(4)}, "lpips")
        for name, level in (("r", 0.1), (FREE, 0.2))
    ]
    record = results(runs)
    assert one(record, metric="lpips")["noise"] is None
    assert cells(control_section(record), "x") == ["−0.100? [−0.100, −0.100]"]  # noqa: RUF001


def test_over_scenes_one_control_is_taken_and_the_scene_is_the_unit() -> None:
    table = {  # by scene: the recipe, the first control, the second
        "x": (33.0, 32.0, 30.0),
        "y": (34.0, 30.0, 31.0),
        "z": (31.0, 31.5, 29.0),
    }
    runs = [
        run(scene, name, 0, psnr=value)
        for scene, row in table.items()
        for name, value in zip(("r", FREE, LOOSE), row, strict=True)
    ]
    record = results(runs)
    assert [one(record, scene=s)["other"] for s in "xyz"] == [FREE, LOOSE, FREE]
    found = one(record, scene=None)
    expected = stats.ttest_1samp([1.0, 4.0, -0.5], 0).confidence_interval(0.95)
    assert found["other"] == FREE
    assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high))
    assert (found["over"], found["count"], found["noise"]) == ("scenes", 3, True)
    text = markdown(record)
    assert "## What polarization buys" in text
    assert "| over scenes | 3 scenes | ≈ +1.50 \\[−4.19, +7.19\\] a |" in text  # noqa: RUF001


def test_what_has_not_finished_is_never_paired() -> None:
    runs = [run("x", "r", 0, psnr=33.0), unfinished("x", FREE, 0, "disk full"), run("x", LOOSE, 0, psnr=31.0)]
    runs += [run("y", "r", 0, psnr=33.0), unfinished("y", FREE, 0), unfinished("y", LOOSE, 0)]
    runs += [run("y", LOOSE, 1, psnr=20.0)]  # of another seed
    record = results(runs)
    (found,) = record["differences"]
    assert (found["scene"], found["other"], found["left_out"]) == ("x", LOOSE, [FREE])
    section = control_section(record)
    assert section is not None
    remarks = [row.labels[0].remark for row in section.blocks[0].rows]
    assert remarks == ["", "no runs to pair", "no runs to pair"]
    assert f"x, r: chosen without {FREE}, for want of runs to pair." in section.notes
    text = markdown(record)
    assert f"`{FREE}` (failed)" in text
    assert f"`{FREE}` (missing)" in text
    assert f"`{LOOSE}` (1 of 2 seeds)" in text
    assert f"`{LOOSE}` (2 of 3 runs)" in text


def test_controls_without_a_common_seed_are_not_chosen_from() -> None:
    runs = [run("x", "r", seed, psnr=33.0) for seed in (0, 1)]
    runs += [run("x", FREE, 0, psnr=31.0), run("x", LOOSE, 1, psnr=32.0)]
    assert results(runs)["differences"] == []


def test_differences_to_a_recipe_that_was_asked_for() -> None:
    table = {"3dgs": 30.0, "s": 29.5, "t": 30.2}
    record = results([run("x", name, 0, psnr=value) for name, value in table.items()], against="3dgs")
    assert [(d["recipe"], d["other"], d["why"]) for d in record["differences"]] == [
        ("s", "3dgs", "against"),
        ("t", "3dgs", "against"),
    ]
    section = against_section(record)
    assert cells(section, "s") == ["−0.50"]  # noqa: RUF001 - worse, and not noise
    assert cells(section, "t") == ["≈ +0.20"]
    assert "## Differences to 3dgs" in markdown(record)
    assert control_section(record) is None


def test_without_a_question_there_is_nothing() -> None:
    record = results([run("x", "r", 0, psnr=30.0)])
    assert record["differences"] == []
    assert differences_csv(record) is None
    assert (control_section(record), against_section(record)) == (None, None)


def test_seconds_and_counts_are_not_compared() -> None:
    values = {"gaussians": 10.0, "fps": 5.0, "train_seconds": 3.0}
    assert results([run("x", "r", 0, **values), run("x", FREE, 0, **values)])["differences"] == []


def test_csv_and_latex() -> None:
    record = results([run("x", "r", 0, psnr=33.125), run("x", FREE, 0, psnr=32.0)])
    text = differences_csv(record)
    assert text is not None
    (row,) = csv.DictReader(io.StringIO(text))
    assert (row["recipe"], row["other"], row["metric"], row["mean"], row["low"]) == (
        "r",
        FREE,
        "psnr",
        "1.125",
        "",
    )
    tex = latex(record)
    assert "% What polarization buys" in tex
    assert "x & none, 1 seed & \\textbf{+1.12} \\\\" in tex
    assert tex.count("\\begin{tabular}") == tex.count("\\end{tabular}") == 2
