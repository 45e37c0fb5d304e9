"""Means, spreads and bests on numbers that can be checked by head, and the three forms of the table."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable

import pytest
from comparison_records import results, run, unfinished

from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.aggregate import aggregate, cell_of
from polarguide.experiments.forms import csv_text, latex, latex_text, markdown
from polarguide.experiments.results import Results
from polarguide.experiments.tables import leading_rows, notes, scores_section

BY_KEY = {column.key: column for column in COLUMNS}


def test_mean_and_sample_standard_deviation_over_seeds() -> None:
    runs = [run("cup", "a", seed, psnr=value) for seed, value in enumerate((30.0, 32.0, 34.0))]
    (row,) = aggregate(runs, ["cup"], ["a"])
    assert row["finished"] == 3
    assert row["cells"]["psnr"] == {"mean": 32.0, "spread": 2.0, "count": 3}
    assert row["cells"]["ssim"] == {"mean": None, "spread": None, "count": 0}


def test_one_seed_has_no_spread() -> None:
    assert cell_of([5.0, None]) == {"mean": 5.0, "spread": None, "count": 1}
    assert cell_of([]) == {"mean": None, "spread": None, "count": 0}


def test_the_mean_over_scenes_weighs_scenes_alike() -> None:
    runs = [run("x", "a", 0, psnr=10.0), run("x", "a", 1, psnr=14.0), run("y", "a", 0, psnr=20.0)]
    row = aggregate(runs, ["x", "y"], ["a"])[-1]
    assert row["scene"] is None
    # Only seed 0 is on both scenes: the mean is that of the scenes' means, and there is no spread.
    assert row["cells"]["psnr"] == {"mean": 16.0, "spread": None, "count": 1}
    runs.append(run("y", "a", 1, psnr=24.0))
    row = aggregate(runs, ["x", "y"], ["a"])[-1]
    assert row["cells"]["psnr"]["mean"] == 17.0  # of 12 and 22
    assert row["cells"]["psnr"]["spread"] == pytest.approx(8**0.5)  # of 15 and 19


def test_means_over_different_scenes_are_not_compared() -> None:
    runs = [
        run("x", "a", 0, psnr=10.0, normal_mae_deg=20.0),
        run("y", "a", 0, psnr=20.0),
        run("x", "b", 0, psnr=11.0, normal_mae_deg=30.0),
        unfinished("y", "b", 0),
    ]
    a, b = aggregate(runs, ["x", "y"], ["a", "b"])[-2:]
    assert a["cells"]["psnr"]["mean"] == 15.0
    assert b["cells"]["psnr"]["mean"] is None
    # y has no normals to compare with for anybody, so that x alone is the mean of both.
    assert (a["cells"]["normal_mae_deg"]["mean"], b["cells"]["normal_mae_deg"]["mean"]) == (20.0, 30.0)


@pytest.mark.parametrize(
    ("key", "values", "best"),
    [
        ("psnr", (30.0, 31.0, 29.0), {1}),
        ("normal_mae_deg", (20.5, 19.0, 21.0), {1}),
        ("psnr", (30.004, 30.0, 29.0), {0, 1}),  # the same number as shown
        ("psnr", (30.0, None, 30.0), {0, 2}),
        ("psnr", (None, 31.0, None), set()),  # nothing to be better than
        ("gaussians", (1.0, 2.0, 3.0), set()),  # neither is better
    ],
)
def test_the_best_is_marked(key: str, values: tuple[float | None, ...], best: set[int]) -> None:
    names = [f"r{index}" for index in range(len(values))]
    runs = [run("cup", name, 0, **{key: value}) for name, value in zip(names, values, strict=True)]
    record = results(runs)
    assert leading_rows(record["table"], BY_KEY[key], record) == best


def test_what_is_not_there_is_told_apart() -> None:
    runs = [
        run("cup", "3dgs", 0, psnr=30.0, gaussians=1200),
        run("cup", "polarguide", 0, psnr=31.0, specular_psnr=25.0, fps=60.0),
        unfinished("cup", "broken", 0, "disk full"),
    ]
    (block,) = scores_section(results(runs)).blocks
    shown = {row.labels[0].text: [cell.value for cell in row.cells] for row in block.rows}
    assert [row.labels[0].remark for row in block.rows] == ["", "", "failed"]
    assert shown == {  # PSNR, specular PSNR, Gaussians, FPS
        "3dgs": ["30.00", "n/a", "1,200", ""],
        "polarguide": ["31.00", "25.00", "n/a", "60.0"],
        "broken": ["", "", "", ""],
    }


def test_markdown() -> None:
    runs = [run("cup", "a", s, psnr=30.0 + s) for s in (0, 1)]
    runs += [run("cup", "b", s, psnr=29.0, normal_within_11=0.125) for s in (0, 1)]
    text = markdown(results(runs))
    assert "| recipe | PSNR (dB) ↑ | normals within 11.25 deg (%) ↑ |" in text
    assert "| `a` | **30.50** ± 0.71 | n/a |" in text
    assert "| `b` | 29.00 ± 0.00 | 12.5 ± 0.0 |" in text
    assert "LPIPS n/a: no weights." in text
    assert "mesh F-score" not in text
    assert "SSIM" not in text, "a column without values"
    assert "over 2 seeds" in text


def test_scene_and_error_text_cannot_break_markdown() -> None:
    runs = [run("a|b*", "r", 0, psnr=1.0), unfinished("a|b*", "s", 0, "no <b>\nfile_")]
    text = markdown(results(runs))
    assert "## a|b\\*" in text
    assert "no \\<b\\> file\\_" in text


def test_csv_has_every_column_in_full_precision() -> None:
    runs = [run("x, y", "a", 0, psnr=30.123456789), run("z", "a", 0, psnr=1.0)]
    rows = list(csv.DictReader(io.StringIO(csv_text(results(runs)))))
    assert list(rows[0]) == ["scene", "recipe", "runs", *(f"{k}{e}" for k in BY_KEY for e in ("", "_spread"))]
    assert (rows[0]["scene"], rows[0]["psnr"], rows[0]["ssim"]) == ("x, y", "30.123456789", "")
    assert [row["scene"] for row in rows] == ["x, y", "z", ""]


def test_latex() -> None:
    runs = [run("my_cup", "a", s, psnr=30.0 + s) for s in (0, 1)] + [run("my_cup", "b&c", 0, psnr=29.0)]
    text = latex(results(runs))
    assert "\\emph{my\\_cup}" in text
    assert "a (2 seeds) & \\textbf{30.50} $\\pm$ 0.71 \\\\" in text
    assert "b\\&c (1 seed) & 29.00 \\\\" in text
    assert "PSNR (dB) $\\uparrow$" in text
    for word in ("\\toprule", "\\midrule", "\\bottomrule", "\\begin{tabular}{lr}", "\\end{tabular}"):
        assert word in text


def test_latex_special_characters_are_escaped() -> None:
    assert latex_text("50% of $x_1 & {y} #2 ~^\\") == (
        r"50\% of \$x\_1 \& \{y\} \#2 \textasciitilde{}\textasciicircum{}\textbackslash{}"
    )


def test_a_comment_of_latex_stays_one() -> None:
    runs = [run("x", "a", 0, psnr=1.0), unfinished("x", "b", 0, "first\nsecond")]
    after = latex(results(runs)).split("\\end{tabular}\n")[1]
    assert all(line.startswith("%") for line in after.splitlines())


def test_notes_name_what_failed() -> None:
    said = notes(
        results([run("x", "a", 0, lpips=0.1), unfinished("x", "b", 0, "disk full"), unfinished("x", "c", 0)])
    )
    assert "x, b, seed 0 failed: disk full" in said
    assert "x, c, seed 0 has not finished" in said
    assert not any("LPIPS" in note for note in said)


def test_notes_name_the_scene_whose_truth_is_not_complete() -> None:
    record = results([run("x", "a", 0, psnr=30.0), run("y", "a", 0, psnr=30.0)])
    record["scenes"][1]["warnings"] = ["The ground truth gives normals of 1 of 2 test views."]
    assert "y: The ground truth gives normals of 1 of 2 test views." in notes(record)
    assert not any(note.startswith("x:") for note in notes(record))
    assert "normals of 1 of 2" in markdown(record)


@pytest.mark.parametrize("write", [markdown, latex, csv_text])
def test_terminals_obey_no_name_in_a_file(write: Callable[[Results], str]) -> None:
    text = write(results([run("s\x1b[2J", "a\x1b]0;mine\x07", 0, psnr=30.0)]))
    assert all(sign.isprintable() or sign == "\n" for sign in text)
    assert "x1b" in text


def test_names_are_no_formulas_in_a_spreadsheet() -> None:
    rows = list(
        csv.DictReader(
            io.StringIO(csv_text(results([run(name, "a", 0, psnr=30.0) for name in ("=1+1", "@x", "cup")])))
        )
    )
    assert {row["scene"] for row in rows} >= {"'=1+1", "'@x", "cup"}


def test_why_a_mesh_has_no_score_is_said_once() -> None:
    runs = [run("x", name, 0) | {"mesh_reason": "skimage is not installed"} for name in "ab"]
    said = notes(results(runs))  # type: ignore[arg-type]
    assert said.count("mesh F-score 1 % n/a: skimage is not installed.") == 1
