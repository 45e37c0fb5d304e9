"""Means, spreads and tables on numbers that can be checked by head, and the files that hold them."""

import io
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from comparison_records import part, results, run, unfinished

from polarguide.results.evaluation.table import COLUMNS
from polarguide_bench.results import Cell, Results, cell_of
from polarguide_bench.tables import (
    Section,
    against_section,
    control_section,
    csv_text,
    latex_text,
    notes,
    part_section,
    readable,
    scores_section,
    sections,
    write_tables,
)

FREE, LOOSE = "r:unpolarized", "r:unpolarized-without-consistency"


def seen(scene: str, recipe: str, seed: int, **parts: dict[str, Any]) -> dict[str, Any]:
    """Return a run with objects, and with materials of the same scores."""
    made = run(scene, recipe, seed, psnr=30.0)
    materials = {scores["material"]: scores for scores in parts.values() if scores["material"]}
    return made | {"objects": parts, "materials": materials}


def ball(**metrics: float | None) -> dict[str, Any]:
    return part("metal", **metrics)


def rows(section: Section, block: int = 0) -> dict[tuple[str, ...], list[str]]:
    """Shown cells by labels; bold ones have a star."""
    _, found = section.blocks[block]
    return {
        tuple(text + (f" ({remark})" if remark else "") for text, _, remark in labels): [
            " ".join(filter(None, ("*" * bold + value, more))) for value, more, bold in cells
        ]
        for labels, cells in found
    }


def text(found: Results, name: str = "results.md") -> str:
    return readable(sections(found), name)


def test_mean_and_sample_standard_deviation_over_seeds() -> None:
    found = results([run("cup", "a", seed, psnr=value) for seed, value in enumerate((30.0, 32.0, 34.0))])
    (row,) = found.table
    assert (row.finished, row.cells["psnr"], row.cells["ssim"]) == (3, Cell(32.0, 2.0, 3), Cell())
    assert found.scores.loc[0, ["runs", "psnr", "psnr_spread"]].tolist() == [3, 32.0, 2.0]
    assert (cell_of([5.0, None]), cell_of([])) == (Cell(5.0, None, 1), Cell())


def test_the_mean_over_scenes_weighs_scenes_alike() -> None:
    runs = [run("x", "a", 0, psnr=10.0), run("x", "a", 1, psnr=14.0), run("y", "a", 0, psnr=20.0)]
    row = results(runs).table[-1]
    # Only seed 0 is on both scenes: the mean is that of the scenes' means, and there is no spread.
    assert (row.scene, row.cells["psnr"]) == (None, Cell(16.0, None, 1))
    cell = results([*runs, run("y", "a", 1, psnr=24.0)]).table[-1].cells["psnr"]
    assert (cell.mean, cell.spread) == (17.0, pytest.approx(8**0.5))  # of 12 and 22; of 15 and 19


def test_means_over_different_scenes_are_not_compared() -> None:
    runs = [
        run("x", "a", 0, psnr=10.0, normal_mae_deg=20.0),
        run("y", "a", 0, psnr=20.0),
        run("x", "b", 0, psnr=11.0, normal_mae_deg=30.0),
        unfinished("y", "b", 0),
    ]
    means = results(runs).scores.set_index("recipe").iloc[-2:]
    assert means.loc["a", "psnr"] == 15.0
    assert pd.isna(means.loc["b", "psnr"])
    # y has no normals to compare with for anybody, so that x alone is the mean of both.
    assert means["normal_mae_deg"].tolist() == [20.0, 30.0]


def test_runs_are_a_frame_with_their_states_and_scores() -> None:
    frame = results([run("x", "a", 0, psnr=30.0), unfinished("x", "b", 0, "disk full")]).runs
    assert frame[["recipe", "state", "error"]].fillna("").to_numpy().tolist() == [
        ["a", "done", ""], ["b", "failed", "disk full"],
    ]  # fmt: skip
    assert frame["psnr"].dropna().tolist() == [30.0]


def test_what_is_not_there_is_told_apart() -> None:
    runs = [
        run("cup", "3dgs", 0, psnr=30.0, gaussians=1200),
        run("cup", "polarguide", 0, psnr=31.0, specular_psnr=25.0, fps=60.0),
        unfinished("cup", "broken", 0, "disk full"),
    ]
    assert rows(scores_section(results(runs))) == {  # PSNR, specular PSNR, Gaussians, FPS
        ("3dgs",): ["30.00", "n/a", "1,200", ""],
        ("polarguide",): ["*31.00", "25.00", "n/a", "60.0"],
        ("broken (failed)",): ["", "", "", ""],
    }


def test_notes_name_what_failed_and_what_scores_do_not_mean() -> None:
    runs = [run("x", "a", 0, lpips=0.1), unfinished("x", "b", 0, "disk full"), unfinished("x", "c", 0)]
    runs += [run("y", name, 0) | {"mesh_reason": "skimage is not installed"} for name in "ab"]
    found = results(runs)
    found.record.scenes[1].warnings = ["The ground truth gives normals of 1 of 2 test views."]
    stated = notes(found)
    assert stated.count("mesh F-score 1 % n/a: skimage is not installed.") == 1
    for note in (
        "x, b, seed 0 failed: disk full",
        "x, c, seed 0 has not finished",
        "LPIPS n/a: no weights.",
        "y: The ground truth gives normals of 1 of 2 test views.",
    ):
        assert note in stated
    assert not any(note.startswith("x:") for note in stated)


def test_what_polarization_buys_is_shown_with_its_interval_and_marks() -> None:
    table = {"r": (33.0, 6.0), FREE: (31.0, 9.0), LOOSE: (32.0, 14.0)}
    section = control_section(
        results([run("x", name, 0, psnr=p, normal_mae_deg=n) for name, (p, n) in table.items()])
    )
    assert rows(section) == {("x", "none, 1 seed"): ["*+1.00 b", "*−3.0 a"]}  # noqa: RUF001
    assert section.headings == ["PSNR (dB) ↑", "normal error (deg) ↓"]
    assert any(FREE in note and LOOSE in note for note in section.notes)
    runs = [run(s, n, 0, psnr=v) for s, a, b in ("xab", "ycd", "zef") for n, v in (("r", 31.0), (FREE, 30.8))]
    runs[0]["views"] = {f"v{k}": {"psnr": 31.0 + k} for k in range(4)}
    runs[1]["views"] = {f"v{k}": {"psnr": 30.8 + k} for k in range(4)}
    found = results(runs)
    interval = "≈ +0.20 [+0.20, +0.20]"
    assert rows(control_section(found)) == {
        ("x", "4 views of 1 seed"): [interval],
        ("y", "none, 1 seed"): ["≈ +0.20"],
        ("z", "none, 1 seed"): ["≈ +0.20"],
        ("over scenes", "3 scenes"): ["*+0.20 [+0.20, +0.20]"],
    }
    assert "| over scenes | 3 scenes | **+0.20** \\[+0.20, +0.20\\] |" in text(found)


def test_rows_without_runs_to_pair_say_so() -> None:
    runs = [run("x", "r", 0, psnr=33.0), unfinished("x", FREE, 0, "disk full"), run("x", LOOSE, 0, psnr=31.0)]
    runs += [run("y", "r", 0, psnr=33.0), unfinished("y", FREE, 0), unfinished("y", LOOSE, 0)]
    runs += [run("y", LOOSE, 1, psnr=20.0)]  # of another seed
    found = results(runs)
    section = control_section(found)
    assert [labels[0] for labels in rows(section)] == [
        "x", "y (no runs to pair)", "over scenes (no runs to pair)",
    ]  # fmt: skip
    (note,) = (note for note in section.notes if "chosen without" in note)
    assert note.startswith("x, r: ")
    assert FREE in note
    for label in (f"`{FREE}` (failed)", f"`{FREE}` (missing)", f"`{LOOSE}` (1 of 2 seeds)"):
        assert label in text(found)
    assert f"`{LOOSE}` (2 of 3 runs)" in text(found)


def test_differences_to_a_recipe_that_was_asked_for() -> None:
    table = {"3dgs": 30.0, "s": 29.0, "t": 30.2}
    found = results([run("x", name, 0, psnr=value) for name, value in table.items()], against="3dgs")
    assert rows(against_section(found)) == {
        ("s", "none, 1 seed"): ["−1.00"],  # noqa: RUF001 - worse, and not noise
        ("t", "none, 1 seed"): ["≈ +0.20"],
    }
    assert [section.key for section in sections(found)] == ["scores", "against"]


def test_a_row_for_every_object_and_a_column_for_every_recipe() -> None:
    runs = [
        seen("x", "3dgs", 0, ball=ball(psnr=30.0, metal_share=0.815), vase=part("plastic", psnr=25.0)),
        seen("x", "r", 0, ball=ball(psnr=29.0, specular_psnr=20.0), vase=part("plastic", psnr=26.0)),
        seen("y", "3dgs", 0, ball=ball(psnr=10.0)),
        unfinished("y", "r", 0),
    ]
    found = results(runs)
    section = part_section(found, "object")
    assert section.headings == ["3dgs", "r"]
    assert [title for title, _ in section.blocks] == [
        "PSNR (dB) ↑", "specular PSNR (dB) ↑", "taken for metal (%)",
    ]  # fmt: skip
    assert rows(section) == {
        ("x", "ball", "metal"): ["30.00", "29.00"],
        ("x", "vase", "plastic"): ["25.00", "26.00"],
        ("y", "ball", "metal"): ["10.00", ""],
    }
    assert rows(section, 1) == {("x", "ball", "metal"): ["", "20.00"]}
    assert rows(section, 2) == {("x", "ball", "metal"): ["81.5", ""]}
    # The recipe r lacks the metal of one scene, so its mean would be over other scenes.
    assert rows(part_section(found, "material")) == {
        ("metal", "x, y"): ["20.00", ""],
        ("plastic", "x"): ["25.00", "26.00"],
    }
    assert part_section(results([run("x", "r", 0, psnr=30.0)]), "object").blocks == []


def test_what_polarization_buys_by_object_is_paired_by_seed() -> None:
    gain = {0: 1.0, 1: 1.2, 2: 0.9}
    runs = [seen("x", "r", s, ball=ball(psnr=30.0 + 5 * s + g, ssim=0.9)) for s, g in gain.items()]
    runs += [seen("x", FREE, s, ball=ball(psnr=30.0 + 5 * s, ssim=0.9)) for s in gain]
    section = part_section(results(runs), "object")
    assert rows(section) == {("x", "ball", "metal"): ["*36.03", "35.00", "*+1.03"]}
    # Equal in every seed: a difference of 0 for sure.
    assert rows(section, 1) == {("x", "ball", "metal"): ["0.900", "0.900", "≈ +0.000"]}
    one = results([seen("x", "r", 0, ball=ball(psnr=33.0)), seen("x", FREE, 0, ball=ball(psnr=30.0))])
    assert rows(part_section(one, "object")) == {("x", "ball", "metal"): ["33.00", "30.00", "+3.00?"]}


def test_frames_are_the_csv_files(tmp_path: Path) -> None:
    parts = {
        "ball": ball(psnr=30.123456789, metal_share=0.75),
        "rock": part(None, psnr=1.0),
    }
    runs = [seen("x, y", "r", s, **parts) for s in (0, 1)]
    runs += [run("x, y", FREE, s, psnr=28.0, haze_true=0.125 + s / 8) for s in (0, 1)]
    found = results([*runs, run("z", "r", 0, psnr=1.0)])
    write_tables(tmp_path, found)
    scores = pd.read_csv(tmp_path / "results.csv")
    assert scores.columns.tolist()[:5] == ["scene", "recipe", "runs", "psnr", "psnr_spread"]
    assert len(scores.columns) == 3 + 2 * len(COLUMNS)
    same = [name for name in scores.columns if name in found.scores.columns]
    pd.testing.assert_frame_equal(scores[same], found.scores[same], check_dtype=False)
    # Shares are in percent, as tables show them, and their names say so.
    assert {c.key for c in COLUMNS} - set(same) == {
        c.key for c in COLUMNS if c.unit == "%" and c.factor == 100
    }
    free = scores.set_index(["scene", "recipe"]).loc[("x, y", FREE)]
    assert free["haze_true_percent"] == 18.75
    assert free["haze_true_percent_spread"] == pytest.approx(12.5 / 2**0.5)
    differences = pd.read_csv(tmp_path / "differences.csv")
    assert differences["mean"].tolist() == found.differences["mean"].tolist()
    parts = pd.read_csv(tmp_path / "parts.csv").set_index("name")
    assert parts.loc["ball", ["part", "material", "runs", "psnr"]].tolist() == [
        "object",
        "metal",
        2,
        30.123456789,
    ]
    assert parts.loc["ball", "metal_share_percent"] == 75
    # Files of an earlier comparison in the folder are removed.
    write_tables(tmp_path, results([run("z", "r", 0, psnr=1.0)]))
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".csv", ".json", ".md", ".tex"]


def test_markdown() -> None:
    runs = [run("a|b*", "a", s, psnr=30.0 + s) for s in (0, 1)]
    runs += [run("a|b*", "b", s, psnr=29.0, normal_within_11=0.125) for s in (0, 1)]
    made = text(results([*runs, unfinished("a|b*", "s", 0, "no <b>\nfile_")]))
    assert made.startswith(
        "# Comparison\n\n## a|b\\*\n\n| recipe | PSNR (dB) ↑ | normals within 11.25 deg (%) ↑ |\n|---|---:|---:|\n"
    )
    assert (
        "| `a` (2 seeds) | **30.50** ± 0.71 | n/a |\n| `b` (2 seeds) | 29.00 ± 0.00 | 12.5 ± 0.0 |\n" in made
    )
    assert "no \\<b\\> file\\_" in made
    assert "SSIM" not in made, "a column without values"
    objects = text(results([seen("x", "r", 0, **{"a|b": ball(psnr=1.0)})]))
    assert "## By object\n\n### PSNR (dB) ↑\n" in objects
    assert "| x | a\\|b | metal | 1.00 |" in objects


def test_latex() -> None:
    runs = [run("my_cup", "a", s, psnr=30.0 + s) for s in (0, 1)] + [run("my_cup", "b&c", 0, psnr=29.0)]
    made = text(results([*runs, unfinished("my_cup", "d", 0, "first\nsecond")]), "results.tex")
    for line in (
        "\\begin{tabular}{lr}\n\\toprule\nrecipe & PSNR (dB) $\\uparrow$ \\\\\n\\midrule\n",
        "\\multicolumn{2}{l}{\\emph{my\\_cup}} \\\\\na (2 seeds) & \\textbf{30.50} $\\pm$ 0.71 \\\\\n",
        "b\\&c (1 seed) & 29.00 \\\\\n",
        "\\bottomrule\n\\end{tabular}\n",
    ):
        assert line in made
    assert all(line.startswith("%") for line in made.split("\\end{tabular}\n")[1].splitlines())
    assert latex_text("50% of $x_1 & {y} #2 ~^\\") == (
        r"50\% of \$x\_1 \& \{y\} \#2 \textasciitilde{}\textasciicircum{}\textbackslash{}"
    )
    section = text(results([run("x", "r", 0, psnr=33.125), run("x", FREE, 0, psnr=32.0)]), "results.tex")
    assert "% Gain by polarization\n\\begin{tabular}{llr}" in section
    assert "x & none, 1 seed & \\textbf{+1.12} \\\\" in section


def test_terminals_and_spreadsheets_obey_no_name_in_a_file() -> None:
    found = results([run("s\x1b[2J", "a\x1b]0;mine\x07", 0, psnr=30.0)])
    for made in (text(found), text(found, "results.tex"), csv_text(found.scores)):
        assert all(sign.isprintable() or sign == "\n" for sign in made)
        assert "x1b" in made
    formulas = results([run(name, "a", 0, psnr=30.0) for name in ("=1+1", "@x", "cup")])
    assert pd.read_csv(io.StringIO(csv_text(formulas.scores)))["scene"].tolist()[:3] == [
        "'=1+1",
        "'@x",
        "cup",
    ]
