"""A run of the subject alone: what is outside the masks is black to training, scores and everyone who opens it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import polarguide
from polarguide.capture import load_scene
from polarguide.capture.split import chosen_views, far_from_training
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SceneOptions
from polarguide.training.settings import TrainSettings

READING = SceneOptions(downscale=4)
MASKED = TrainSettings(steps=10, background="masked")


@pytest.fixture
def masked_scene(demo_scene: Path, tmp_path: Path) -> Path:
    """The demo scene with masks of the user's: the middle of each picture."""
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene)
    (scene / "masks").mkdir(exist_ok=True)
    for view in load_scene(demo_scene).views:
        shape = view.codes.shape[1:3]
        mask = np.zeros(shape, np.uint8)
        mask[shape[0] // 4 : -shape[0] // 4, shape[1] // 4 : -shape[1] // 4] = 255
        cv2.imwrite(str(scene / "masks" / f"{view.name}.png"), mask)
    return scene


def test_everything_outside_the_masks_is_black_also_when_the_run_is_opened(
    masked_scene: Path, tmp_path: Path
) -> None:
    run = polarguide.train(masked_scene, tmp_path / "run", settings=MASKED, reading=READING)
    assert len(run.gaussians["means"]) <= len(load_scene(masked_scene).points), "no far Gaussians"
    opened = polarguide.open_run(tmp_path / "run")
    whole = load_scene(masked_scene, downscale=4)
    for view in opened.scene.views:
        mask = view.mask
        assert mask is not None
        assert not bool(view.codes.int()[:, ~mask].any())
        assert bool((view.codes.int() == whole.view(view.name).codes.int())[:, mask].all())
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["background"] == "masked"


def test_a_scene_without_masks_is_refused_before_anything_is_written(
    demo_scene: Path, tmp_path: Path
) -> None:
    with pytest.raises(PolarguideError, match="a mask of every view for --background masked"):
        polarguide.train(demo_scene, tmp_path / "run", settings=MASKED, reading=READING)
    assert not (tmp_path / "run").exists()


def test_the_run_records_which_views_were_held_out(demo_scene: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene, ignore=shutil.ignore_patterns("split.json"))
    held = {}
    for split in ("directions", "every-8th"):
        reading = SceneOptions(downscale=4, split=split)  # type: ignore[arg-type]
        polarguide.train(scene, tmp_path / split, settings=TrainSettings(steps=2), reading=reading)
        held[split] = polarguide.open_run(tmp_path / split).scene.test_names
        assert list(held[split]) == json.loads((tmp_path / split / "run.json").read_text())["test_views"]
    names = [view.name for view in load_scene(scene).views]
    assert held["every-8th"] == tuple(names[::8])
    assert held["directions"] != held["every-8th"]
    again = {"settings": TrainSettings(steps=2), "reading": reading, "resume": True}
    with pytest.raises(PolarguideError, match="test_views"):
        polarguide.train(scene, tmp_path / "directions", **again)


def test_opening_a_run_does_not_judge_a_split_that_is_not_its_own(demo_scene: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene, ignore=shutil.ignore_patterns("split.json"))
    run = polarguide.train(scene, tmp_path / "run", settings=TrainSettings(steps=2), reading=READING)
    first = run.scene.views[0].name  # held out by its place among the names
    far = dataclasses.replace(run.scene.views[0].camera, translation=torch.tensor([50.0, 0.0, 0.0]).double())
    cameras = {view.name: view.camera for view in run.scene.views} | {first: far}
    assert far_from_training(cameras, chosen_views(cameras, "every-8th")) == [first]
    assert far_from_training(cameras, chosen_views(cameras, "directions")) == []
    tests = load_scene(scene, split="every-8th", test_views=run.scene.test_names)
    assert tests.test_names == run.scene.test_names
    assert not [warning for warning in tests.warnings if "far from" in warning]


def test_a_run_of_before_the_record_holds_out_every_eighth(demo_scene: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene, ignore=shutil.ignore_patterns("split.json"))
    polarguide.train(scene, tmp_path / "run", settings=TrainSettings(steps=2), reading=READING)
    path = tmp_path / "run" / "run.json"
    record = json.loads(path.read_text())
    del record["test_views"], record["settings"]["background"]
    path.write_text(json.dumps(record))
    names = [view.name for view in load_scene(scene).views]
    assert polarguide.open_run(tmp_path / "run").scene.test_names == tuple(names[::8])
