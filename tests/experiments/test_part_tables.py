"""Scores by object and by material."""

from __future__ import annotations

import csv
import io
from typing import Any

from comparison_records import part, results, run, unfinished

from polarguide.experiments.forms import markdown, parts_csv
from polarguide.experiments.part_tables import material_section, object_section
from polarguide.experiments.shown import Section

FREE = "r:unpolarized"


def seen(scene: str, recipe: str, seed: int, **parts: dict[str, Any]) -> dict[str, Any]:
    """A run with objects, and with materials of the same scores."""
    made = run(scene, recipe, seed, psnr=30.0)
    materials = {scores["material"]: scores for scores in parts.values() if scores["material"]}
    return made | {"objects": parts, "materials": materials}


def rows(section: Section | None, block: int = 0) -> dict[tuple[str, ...], list[str]]:
    """Shown values by labels; bold ones have a star."""
    assert section is not None
    return {
        tuple(label.text for label in row.labels): ["*" * c.bold + c.value for c in row.cells]
        for row in section.blocks[block].rows
    }


def ball(**metrics: float | None) -> dict[str, Any]:
    return part("metal", **metrics)


def test_a_row_for_every_object_and_a_column_for_every_recipe() -> None:
    runs = [
        seen("x", "3dgs", 0, ball=ball(psnr=30.0), vase=part("plastic", psnr=25.0)),
        seen("x", "r", 0, ball=ball(psnr=29.0, specular_psnr=20.0), vase=part("plastic", psnr=26.0)),
        seen("y", "3dgs", 0, ball=ball(psnr=10.0)),
        unfinished("y", "r", 0),
    ]
    section = object_section(results(runs))
    assert section is not None
    assert section.headings == ("3dgs", "r")
    assert [block.title for block in section.blocks] == ["PSNR (dB) ↑", "specular PSNR (dB) ↑"]
    assert rows(section) == {
        ("x", "ball", "metal"): ["*30.00", "29.00"],
        ("x", "vase", "plastic"): ["25.00", "*26.00"],
        ("y", "ball", "metal"): ["10.00", ""],
    }
    assert rows(section, 1) == {("x", "ball", "metal"): ["", "20.00"]}


def test_what_is_taken_for_metal_is_told_of_those_that_know_metals() -> None:
    runs = [
        seen(
            "x",
            "r",
            0,
            ball=ball(psnr=30.0, metal_share=0.815),
            vase=part("plastic", psnr=25.0, metal_share=0.0),
        ),
        seen("x", "3dgs", 0, ball=ball(psnr=30.0), vase=part("plastic", psnr=25.0)),
    ]
    section = object_section(results(runs))
    assert section is not None
    assert section.blocks[1].title == "taken for metal (%)"
    assert rows(section, 1) == {("x", "ball", "metal"): ["81.5", ""], ("x", "vase", "plastic"): ["0.0", ""]}
    table = parts_csv(results(runs))
    assert table is not None
    assert next(csv.DictReader(io.StringIO(table)))["metal_share"] == "0.815"


def test_materials_are_means_over_the_scenes_that_have_them() -> None:
    runs = [
        seen("x", "r", 0, ball=ball(psnr=30.0), vase=part("plastic", psnr=25.0)),
        seen("y", "r", 0, ball=ball(psnr=20.0)),
        seen("x", "s", 0, ball=ball(psnr=31.0), vase=part("plastic", psnr=26.0)),
        unfinished("y", "s", 0),
    ]
    # Of s, one scene is missing: its mean would be one of other scenes.
    assert rows(material_section(results(runs))) == {
        ("metal", "x, y"): ["25.00", ""],
        ("plastic", "x"): ["25.00", "*26.00"],
    }


def test_what_polarization_buys_by_object_is_paired_by_seed() -> None:
    gain = {0: 1.0, 1: 1.2, 2: 0.9}
    runs = [seen("x", "r", s, ball=ball(psnr=30.0 + 5 * s + g, ssim=0.9)) for s, g in gain.items()]
    runs += [seen("x", FREE, s, ball=ball(psnr=30.0 + 5 * s, ssim=0.9)) for s in gain]
    section = object_section(results(runs))
    assert section is not None
    assert section.headings[:2] == ("r", FREE)
    assert rows(section) == {("x", "ball", "metal"): ["*36.03", "35.00", "*+1.03"]}
    # Equal in every seed: a difference of 0 for sure.
    assert rows(section, 1) == {("x", "ball", "metal"): ["*0.900", "*0.900", "≈ +0.000"]}


def test_one_seed_says_nothing_of_noise_by_object() -> None:
    runs = [seen("x", "r", 0, ball=ball(psnr=33.0)), seen("x", FREE, 0, ball=ball(psnr=30.0))]
    assert rows(object_section(results(runs))) == {("x", "ball", "metal"): ["*33.00", "30.00", "+3.00?"]}


def test_without_objects_there_are_no_tables() -> None:
    record = results([run("x", "r", 0, psnr=30.0)])
    assert (object_section(record), material_section(record), parts_csv(record)) == (None, None, None)


def test_markdown_and_csv() -> None:
    record = results(
        [seen("x", "r", s, ball=ball(psnr=30.0 + s), rock_1=part(None, psnr=1.0)) for s in (0, 1)]
    )
    text = markdown(record)
    assert "## By object" in text
    assert "| x | ball | metal | 30.50 |" in text
    assert "| x | rock\\_1 |  | 1.00 |" in text
    assert "## By material" in text
    table = parts_csv(record)
    assert table is not None
    first = next(csv.DictReader(io.StringIO(table)))
    assert (first["part"], first["name"], first["material"], first["runs"], first["psnr"], first["ssim"]) == (
        "object", "ball", "metal", "2", "30.5", "",
    )  # fmt: skip
