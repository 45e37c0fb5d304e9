"""Refractive indices that the user says objects have: from ``materials/`` to the Gaussians, and through a training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import polarguide
from polarguide.capture import load_scene
from polarguide.errors import PolarguideError
from polarguide.options import SceneOptions
from polarguide.raster.cpu import rasterize_cpu
from polarguide.runs.folder import CHECKPOINT
from polarguide.runs.train import TrainingStopped
from polarguide.training.indices import index_offsets, index_picture
from polarguide.training.settings import TrainSettings

READING = SceneOptions(downscale=4)
TABLE = {"3": {"refractive_index": 1.33, "name": "water"}, "4": {"refractive_index": 1.8}}


def said(demo_scene: Path, folder: Path, table: object = TABLE, *, left: int = 3, right: int = 1) -> Path:
    """The demo scene, of which the left half of each third picture is said to be one material, the right another."""
    scene = folder / "scene"
    shutil.copytree(demo_scene, scene)
    about = scene / "scene.json"
    known = json.loads(about.read_text()) if about.exists() else {}
    about.write_text(json.dumps({**known, "materials": table}))
    (scene / "materials").mkdir()
    for view in load_scene(demo_scene).views[::3]:
        height, width = view.codes.shape[1:3]
        numbers = np.full((height, width), right, np.uint8)
        numbers[:, : width // 2] = left
        cv2.imwrite(str(scene / "materials" / f"{view.name}.png"), numbers)
    return scene


def test_a_scene_has_the_indices_of_its_materials(demo_scene: Path, tmp_path: Path) -> None:
    scene = load_scene(said(demo_scene, tmp_path))
    assert scene.indices == {3: 1.33, 4: 1.8}
    assert load_scene(demo_scene).indices == {}
    materials = scene.views[0].materials
    assert materials is not None
    assert set(materials.unique().tolist()) == {1, 3}


@pytest.mark.parametrize(
    ("table", "left", "message"),
    [
        (TABLE, 5, r"materials.*\.png: expected the numbers 0, 1, 2, 3, 4, found 5"),
        ({}, 3, r"materials.*\.png: expected the numbers 0, 1, 2, found 3"),
        (TABLE, 255, "not levels of gray"),
        (
            {"2": {"refractive_index": 1.4}},
            2,
            r"scene.json \(materials\): expected numbers from 3 to 255, found '2'",
        ),
        ({"water": {"refractive_index": 1.4}}, 1, "found 'water'"),
        ({"3": {"refractive_index": 0.9}}, 3, "refractive_index"),
        ({"3": {}}, 3, "refractive_index"),
        ([1.33], 3, "materials"),
    ],
)
def test_what_nobody_explains_is_refused(
    demo_scene: Path, tmp_path: Path, table: object, left: int, message: str
) -> None:
    scene = said(demo_scene, tmp_path, table, left=left)
    with pytest.raises(PolarguideError, match=message):
        load_scene(scene)


def test_gaussians_get_the_index_of_what_most_of_their_pixels_show(demo_scene: Path, tmp_path: Path) -> None:
    run = polarguide.train(demo_scene, tmp_path / "run", settings=TrainSettings(60), reading=READING)
    scene = load_scene(said(demo_scene, tmp_path), downscale=4)
    gaussians = {name: values.detach() for name, values in run.gaussians.items()}
    one = [view for view in scene.views if view.materials is not None][:1]
    offsets = index_offsets(gaussians, one, scene.indices, 1.5, rasterize_cpu)
    assert {round(value, 5) for value in offsets.unique().tolist()} == {0.0, -0.17}
    picture = index_picture({**gaussians, "index_offset": offsets}, one[0].camera, rasterize_cpu, 1.5)
    assert picture is not None
    half = picture.shape[1] // 2
    covered = run.result(one[0].name).alpha > 0.9
    assert float(picture[:, : half - 2][covered[:, : half - 2]].mean()) < 1.38
    assert float(picture[:, half + 2 :][covered[:, half + 2 :]].mean()) > 1.47
    assert index_picture(gaussians, one[0].camera, rasterize_cpu, 1.5) is None
    assert not bool(index_offsets(gaussians, scene.views[1:2], scene.indices, 1.5, rasterize_cpu).any())


def test_a_training_heeds_them_and_goes_on_to_the_same_bits(demo_scene: Path, tmp_path: Path) -> None:
    scene = said(demo_scene, tmp_path)
    given = {"settings": TrainSettings(40), "reading": READING}
    whole = polarguide.train(scene, tmp_path / "whole", **given)
    calls = iter([*[False] * 30, True])
    with pytest.raises(TrainingStopped):
        polarguide.train(scene, tmp_path / "parts", should_stop=lambda: next(calls), **given)
    polarguide.train(scene, tmp_path / "parts", resume=True, **given)
    assert (tmp_path / "whole" / CHECKPOINT).read_bytes() == (tmp_path / "parts" / CHECKPOINT).read_bytes()
    offsets = whole.gaussians["index_offset"]
    assert float((offsets < 0).float().mean()) > 0.1
    result = whole.result(whole.scene.views[0].name)
    assert result.index is not None
    assert float(result.index.min()) == pytest.approx(1.33, abs=0.03)
    plain = polarguide.train(demo_scene, tmp_path / "plain", **given)
    assert not bool(plain.gaussians["index_offset"].any())
    assert not torch.equal(whole.gaussians["sh_dc"], plain.gaussians["sh_dc"])
