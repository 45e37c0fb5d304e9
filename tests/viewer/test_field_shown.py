"""The viewer over a field: a quarter of the window's pixels, cropped, of runs and trainings."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_fields import small
from textured_ball import textured_ball

from polarguide.neural.trainer import FieldTrainer
from polarguide.presentation import Crop
from polarguide.runs.defaults import resolve
from polarguide.runs.train import train
from polarguide.scene_frame import scene_frame
from polarguide.training.settings import TrainSettings
from polarguide.viewer.appearance import Appearance, Painter
from polarguide.viewer.shown import ShownField, shown_run, shown_training

SCENE = textured_ball(views=6, width=40, height=32, tests=1, radius=1.2)
AROUND = scene_frame([view.camera for view in SCENE.views])


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> ShownField:
    folder = tmp_path_factory.mktemp("field") / "run"
    made = shown_run(train(SCENE, folder, recipe=small(), settings=TrainSettings(steps=3)))
    assert isinstance(made, ShownField)
    return made


@pytest.mark.parametrize("layer", ["final", "normal", "depth", "alpha", "photograph", "error"])
def test_pictures_have_the_windows_size(shown: ShownField, layer: str) -> None:
    view = SCENE.views[0]
    picture = Painter(AROUND).paint(shown, view.camera, Appearance(layer=layer), view)
    assert picture is not None
    assert picture.shape == (32, 40, 3)


def test_a_layer_that_there_is_not_is_not_drawn(shown: ShownField) -> None:
    assert Painter(AROUND).paint(shown, SCENE.views[0].camera, Appearance(layer="specular")) is None


def test_blocks_of_four_are_one_pixel(shown: ShownField) -> None:
    camera = SCENE.views[1].camera
    final = shown.render(camera, depth=False).final
    blocks = final.view(8, 4, 10, 4, 3)
    torch.testing.assert_close(blocks, blocks[:, :1, :, :1].expand_as(blocks))
    exact = shown.model.render(camera.downscaled(4)).final
    torch.testing.assert_close(blocks[:, 0, :, 0], exact)


def test_what_is_cropped_is_black(shown: ShownField) -> None:
    nothing = Crop((0.9, 0.9, 0.9), (0.91, 0.91, 0.91))
    picture = Painter(AROUND).paint(shown, SCENE.views[0].camera, Appearance(crop=nothing))
    assert picture is not None
    assert int(picture.max()) < 5


def test_a_training_is_shown_without_a_change(tmp_path: Path) -> None:
    looked, alone = (
        FieldTrainer(SCENE, small(), resolve(TrainSettings(steps=20), SCENE, small()), torch.device("cpu"))
        for _ in range(2)
    )
    for _ in range(20):
        looked.step(), alone.step()
        made = shown_training(looked)
        assert f"step {looked.state.step} of 20" in made.status
        made.render(SCENE.views[0].camera.downscaled(2), depth=True)
    one, other = looked.state.tensors(), alone.state.tensors()
    assert [name for name in one if one[name].numpy().tobytes() != other[name].numpy().tobytes()] == []
