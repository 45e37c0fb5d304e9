"""The two tables of PolarGuide-GSDR in its own layout."""

from pathlib import Path

import pytest
from comparison_records import results, run
from faults import Fault

from polarguide_bench.join import LAYOUTS, join_tables, measured_section, published_section
from polarguide_bench.recipes import recipe_named
from polarguide_bench.tables import write_tables

FIRST = LAYOUTS["publication-1"]


def test_columns_are_recipes() -> None:
    for layout in LAYOUTS.values():
        for recipe in layout.columns.values():
            assert recipe_named(recipe).name == recipe


def test_scenes_are_blocks_and_metrics_are_rows() -> None:
    values = {"3dgs": 30.0, "polarguide-paper": 31.0, "polarguide-stokes": 33.0}
    scored = [
        run(scene, recipe, seed, psnr=psnr + seed, ssim=0.9, flip=0.1)
        for scene in ("x", "y")
        for recipe, psnr in values.items()
        for seed in (0, 1, 2)
    ]
    section = measured_section(results(scored), FIRST)
    assert section.headings == ["3DGS", "PolarGuide-GSDR, to the letter", "polarguide-stokes"]
    assert [title for title, _ in section.blocks] == ["x", "y"]
    rows = section.blocks[0][1]
    assert [labels[0][0] for labels, _ in rows] == ["PSNR ↑", "SSIM ↑", "FLIP ↓", "FPS ↑"]
    assert [cell[0] for cell in rows[0][1]] == ["31.00", "32.00", "34.00"]
    assert [cell[2] for cell in rows[0][1]] == [False, False, True], "the best is bold"
    assert "FLIP stands for LPIPS." in section.notes
    assert any("gnerp, 3dgs-dr, ref-gs, polarguide-paper:kind" in note for note in section.notes)
    assert any("FPS was not measured" in note for note in section.notes)


def test_lpips_is_shown_where_it_was_measured() -> None:
    scored = [run("x", name, 0, psnr=30.0, lpips=0.2, flip=0.1, fps=40.0) for name in ("3dgs", "3dgs-dr")]
    section = measured_section(results(scored), FIRST)
    labels = [labels[0][0] for labels, _ in section.blocks[0][1]]
    assert labels == ["PSNR ↑", "SSIM ↑", "LPIPS ↓", "FPS ↑"]
    assert not any("stands for" in note or "FPS was not" in note for note in section.notes)


def test_a_record_without_the_recipes_is_refused() -> None:
    other = results([run("x", "polarguide", 0, psnr=30.0)])
    Fault("--layout", "gnerp, 3dgs, 3dgs-dr", "polarguide", "--recipes gnerp 3dgs").raised_by(
        measured_section, other, FIRST
    )


def test_published_values_are_those_of_the_publication() -> None:
    """Spot checks, and the statements of its text: about 1 dB on three datasets, half a decibel on two."""
    first, second = (layout.published() for layout in LAYOUTS.values())
    assert (len(first), len(second)) == (20, 20)
    psnr = first[first["metric"] == "PSNR"].set_index("dataset").drop(columns="metric").astype(float)
    gains = psnr["PolarGuide-GSDR"] - psnr["3DGS-DR"]
    assert [round(gain, 2) for gain in gains] == [1.41, 0.39, 0.98, 1.10, 0.51]
    whole = second[second["metric"] == "PSNR"].set_index("dataset")["PolarGuide-GSDR"].astype(float)
    assert float((psnr["PolarGuide-GSDR"] - whole).abs().max()) == pytest.approx(0.19)
    block = published_section(FIRST).blocks[1]
    assert block[0] == "Gundam (indoor)"
    assert [cell[2] for cell in block[1][1][1]] == [False, False, True, False, False]


def test_values_of_another_version_of_a_recipe_are_named() -> None:
    scored = results([run("x", name, 0, psnr=30.0) for name in ("3dgs-dr", "polarguide-paper")])
    for recipe in scored.record.recipes:
        recipe.data = recipe_named(recipe.name).data() | {"about": "Other words."}
    stated = "was trained with other values"
    assert not any(stated in note for note in measured_section(scored, FIRST).notes)
    scored.record.recipes[1].data["priors"]["threshold"] = 0.05
    named = [note for note in measured_section(scored, FIRST).notes if stated in note]
    assert len(named) == 1
    assert named[0].startswith("polarguide-paper ")


def test_one_command_makes_each_table(tmp_path: Path) -> None:
    """From a comparison with recipes that both layouts have."""
    recipes = ["3dgs-dr", "polarguide-paper", "polarguide-paper:only-normals"]
    (tmp_path / "runs").mkdir()
    write_tables(tmp_path / "runs", results([run("x", name, 0, psnr=30.0) for name in recipes]))
    for layout in LAYOUTS.values():
        out = tmp_path / layout.name
        join_tables([tmp_path / "runs"], out, layout=layout.name)
        text = (out / f"{layout.name}.md").read_text()
        measured = text.split("as published")[0]
        for heading, recipe in layout.columns.items():
            assert (f"| {heading} |" in measured) == (recipe in recipes)
        assert "Gnome (indoor)" in text
        assert r"\begin{tabular}" in (out / f"{layout.name}.tex").read_text()
