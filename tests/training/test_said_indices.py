"""Refractive indices that the user says objects have: from ``materials/`` to the Gaussians, and through a training."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from heard import Heard
from trainings import context_of

import polarguide
from polarguide.capture import load_scene
from polarguide.core.options import SceneOptions
from polarguide.methods import RECIPES
from polarguide.raster.cpu import rasterize_cpu
from polarguide.runs.callbacks import TrainingStopped
from polarguide.runs.folder import CHECKPOINT
from polarguide.training.feed import Feed
from polarguide.training.metals.observations import index_offsets, index_picture
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
    assert set(materials.unique().tolist()) == {1, 3}


@pytest.mark.parametrize(
    ("table", "left", "fault"),
    [
        (TABLE, 5, Fault("v000.png", "0, 1, 2, 3, 4", "5")),
        ({}, 3, Fault("v000.png", "0, 1, 2", "3")),
        (TABLE, 255, Fault("v000.png", "0, 1, 2, 3, 4", "255")),
        ({"2": {"refractive_index": 1.4}}, 2, Fault("scene.json (materials)", "3 to 255", "'2'")),
        ({"water": {"refractive_index": 1.4}}, 1, Fault("scene.json (materials)", "3 to 255", "'water'")),
        ({"03": {"refractive_index": 1.4}}, 1, Fault("scene.json (materials)", "3 to 255", "'03'")),
        ({"3": {"refractive_index": 0.9}}, 3, Fault("refractive_index)", "above 1")),
        ({"3": {}}, 3, Fault("scene.json (materials", "refractive_index", "none")),
        ([1.33], 3, Fault("scene.json (materials)", "{...}", "[1.33]")),
    ],
)
def test_what_nobody_explains_is_refused(
    demo_scene: Path, tmp_path: Path, table: object, left: int, fault: Fault
) -> None:
    fault.raised_by(load_scene, said(demo_scene, tmp_path, table, left=left))


@pytest.fixture(scope="module")
def run(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> polarguide.Run:
    """A training without indices of its own."""
    out = tmp_path_factory.mktemp("indices") / "run"
    return polarguide.train(demo_scene, out, settings=TrainSettings(60), reading=READING)


def test_gaussians_get_the_index_of_what_most_of_their_pixels_show(
    demo_scene: Path, tmp_path: Path, run: polarguide.Run
) -> None:
    scene = load_scene(said(demo_scene, tmp_path), downscale=4)
    gaussians = {name: values.detach() for name, values in run.gaussians.items()}
    one = [view for view in scene.views if view.materials is not None][:1]
    offsets = index_offsets(gaussians, one, scene.indices, 1.5, rasterize_cpu)
    assert {round(value, 5) for value in offsets.unique().tolist()} == {0.0, -0.17}
    picture = index_picture({**gaussians, "index_offset": offsets}, one[0].camera, rasterize_cpu, 1.5)
    half = picture.shape[1] // 2
    covered = run.result(one[0].name).alpha > 0.9
    assert float(picture[:, : half - 2][covered[:, : half - 2]].mean()) < 1.38
    assert float(picture[:, half + 2 :][covered[:, half + 2 :]].mean()) > 1.47
    assert index_picture(gaussians, one[0].camera, rasterize_cpu, 1.5) is None
    assert not bool(index_offsets(gaussians, scene.views[1:2], scene.indices, 1.5, rasterize_cpu).any())


def test_many_materials_are_looked_at_in_turns(demo_scene: Path, tmp_path: Path, run: polarguide.Run) -> None:
    table = {str(number): {"refractive_index": 1.3 + 0.01 * number} for number in range(3, 50)}
    scene = load_scene(said(demo_scene, tmp_path, table), downscale=4)
    view = scene.views[0]
    height, width = view.materials.shape
    numbers = (torch.arange(height * width) // 4 % 47 + 3).view(height, width)
    striped = replace(view, materials=numbers.to(torch.uint8))
    found = index_offsets(run.gaussians, [striped], scene.indices, 1.5, rasterize_cpu)
    alone = [
        index_offsets(run.gaussians, [striped], {number: scene.indices[number]}, 1.5, rasterize_cpu)
        for number in (3, 40)
    ]
    assert len(found.unique()) > 33
    for number, one in zip((3, 40), alone, strict=True):
        mine = (found - (scene.indices[number] - 1.5)).abs() < 1e-6
        assert bool(mine.any())
        assert torch.equal(found[mine], one[mine])
    metals = {**run.gaussians, "metalness": torch.ones(len(found))}
    assert not bool(index_offsets(metals, [striped], scene.indices, 1.5, rasterize_cpu).any())


def test_what_was_measured_is_separated_with_the_index_of_each_pixel(run: polarguide.Run) -> None:
    view, recipe = run.scene.train_views[0], RECIPES["polarguide-stokes"]
    stage = next(stage for stage in recipe.stages if stage.weights.priors)
    gaussians = {name: values.detach() for name, values in run.gaussians.items()}

    def separated(index: float, offset: float) -> torch.Tensor:
        settings = TrainSettings(60, background="scene", refractive_index=index)
        feed = Feed(context_of(run.scene, recipe, settings))
        feed.guide = {**gaussians, "index_offset": torch.full_like(gaussians["index_offset"], offset)}
        priors = feed.targets(59, view, stage.weights).priors
        return priors.diffuse[run.result(view.name).alpha > 0.99]

    as_said, as_of_all, other = separated(1.5, -0.17), separated(1.33, 0.0), separated(1.5, 0.0)
    assert float((as_said - as_of_all).abs().mean()) < 0.05 * float((as_said - other).abs().mean())


@pytest.mark.parametrize(
    ("recipe", "left", "message"),
    [
        ("3dgs-dr", 3, "3dgs-dr"),
        ("polarguide-stokes:unpolarized", 3, "polarguide-stokes:unpolarized"),
        ("polarguide-stokes", 1, "no picture in materials/ of a training view"),
        ("polarguide-stokes", 3, ""),
    ],
)
def test_a_training_says_where_they_count_for_nothing(
    demo_scene: Path, tmp_path: Path, recipe: str, left: int, message: str
) -> None:
    scene, reporter = said(demo_scene, tmp_path, left=left), Heard()
    given = {"recipe": recipe, "settings": TrainSettings(2), "reading": READING, "reporter": reporter}
    polarguide.train(scene, tmp_path / "run", **given)
    warned = [line for line in reporter.said if "refractive indices" in line]
    assert len(warned) == bool(message)
    assert message in "".join(warned)


def test_a_training_heeds_them_and_goes_on_to_the_same_bits(
    demo_scene: Path, trained: Path, tmp_path: Path
) -> None:
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
    assert 1.32 < float(result.layers["index"].min()) < 1.42  # five views say 1.33, and all else has 1.5
    plain = polarguide.open_run(trained)  # nothing is said of the same views
    assert not bool(plain.gaussians["index_offset"].any())
    assert not torch.equal(whole.gaussians["sh_dc"], plain.gaussians["sh_dc"])
