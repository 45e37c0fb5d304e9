"""Objects that ground truth tells apart, and the table of them in scene.json."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from tiny_capture import HEIGHT, WIDTH, TinyCapture

from polarguide.capture import load_scene
from polarguide.capture.ground_truth import Material
from polarguide.errors import PolarguideError

CUP = {
    "id": 2,
    "name": "cup",
    "foreground": True,
    "material": {"type": "pplastic", "alpha": 0.03, "ior": 1.5},
}
GROUND = {
    "id": 1,
    "name": "ground",
    "foreground": False,
    "material": {"type": "pplastic", "alpha": 0.3, "ior": 1.5},
}


def numbered(capture: TinyCapture, objects: Any, ids: np.ndarray | None = None) -> TinyCapture:
    ids = np.ones((HEIGHT, WIDTH), np.uint8) if ids is None else ids
    capture.write_truth("v003", objid=ids)
    capture.write_json("scene.json", {"objects": objects, "scene": "tiny"})
    return capture


def test_the_table_is_read(capture: TinyCapture) -> None:
    ground, cup = load_scene(numbered(capture, [GROUND, CUP]).root).objects
    assert (ground.id, ground.name, ground.foreground) == (1, "ground", False)
    assert (cup.id, cup.material.alpha, cup.material.kind) == (2, 0.03, "dielectric")


def test_a_table_that_nothing_refers_to_may_lack_fields(capture: TinyCapture) -> None:
    capture.write_json("scene.json", {"objects": [{"somebody": "else's"}]})
    assert load_scene(capture.root).objects == ()


@pytest.mark.parametrize(
    ("objects", "parts"),
    [
        ([CUP, {**GROUND, "id": 2}], ("(objects)", "each has its own id", "two with the id 2")),
        ([CUP, {**GROUND, "name": "cup"}], ("(objects)", "each has its own name", "two with the name cup")),
        ([{"name": "cup"}], ("(objects[0])", "the field id", "only name")),
        ([{**CUP, "id": 0}], ("(objects[0].id)", "1 to 65535", "found 0")),
        ([{**CUP, "id": "two"}], ("(objects[0].id)", "a whole number", '"two"')),
        ([{**CUP, "material": "clay"}], ("(objects[0].material)", "a JSON object", '"clay"')),
        ({"cup": 2}, ("(objects)", "a list", '{"cup": 2}')),
    ],
)
def test_a_wrong_table(capture: TinyCapture, objects: Any, parts: tuple[str, ...]) -> None:
    with pytest.raises(PolarguideError) as caught:
        load_scene(numbered(capture, objects).root)
    message = str(caught.value)
    assert "\n" not in message
    for part in ("scene.json", *parts, "Correct it, or remove"):
        assert part in message


@pytest.mark.parametrize(
    ("ids", "found"),
    [
        (np.full((HEIGHT, WIDTH), 1.5), "float64 from 1.5 to 1.5"),
        (np.full((HEIGHT, WIDTH), -1), "int64 from -1 to -1"),
        (np.full((HEIGHT, WIDTH), 70000), "int64 from 70000 to 70000"),
    ],
)
def test_numbers_that_are_none(capture: TinyCapture, ids: np.ndarray, found: str) -> None:
    with pytest.raises(PolarguideError, match=re.escape(found)) as caught:
        load_scene(numbered(capture, [CUP], ids).root)
    assert "gt/v003.npz (objid)" in str(caught.value).replace("\\", "/")


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_number_counts_where_its_whole_box_agrees(capture: TinyCapture, factor: int) -> None:
    ids = np.random.default_rng(0).choice([1, 1, 1, 1, 2], (HEIGHT, WIDTH)).astype(np.uint16)
    depth = np.where(np.random.default_rng(1).uniform(size=ids.shape) < 0.2, 0, 2.0 + ids)
    numbered(capture, [CUP, GROUND], ids)
    capture.write_truth("v003", objid=ids, depth=depth)
    found = load_scene(capture.root, downscale=factor).view("v003").ground_truth
    assert found is not None
    assert found.object_ids is not None
    assert found.depth is not None
    rows, columns = HEIGHT // factor, WIDTH // factor
    assert tuple(found.object_ids.shape) == (rows, columns)
    for y in range(rows):
        for x in range(columns):
            box = np.s_[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
            numbers = set(ids[box].ravel().tolist())
            assert int(found.object_ids[y, x]) == (numbers.pop() if len(numbers) == 1 else 0)
            expected = depth[box].mean() if (depth[box] > 0).all() else 0.0
            assert float(found.depth[y, x]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("material", "kind"),
    [
        (Material("pplastic", 0.03, 1.5), "dielectric"),
        (Material("plastic", 0.15, 1.5), "dielectric"),
        (Material("plastic", 0.16, 1.5), "rough dielectric"),
        (Material("", 0.3, 1.33), "rough dielectric"),
        (Material("roughconductor", 0.12), "metal"),
        (Material("metal", 0.3), "rough metal"),
        (Material("chrome", 0.01, k=[3.0, 3.0, 3.0]), "metal"),
        (Material("matte"), "matte"),
        (Material(), None),
        (Material("wax", 0.2), None),
    ],
)
def test_classes_of_material(material: Material, kind: str | None) -> None:
    assert material.kind == kind
