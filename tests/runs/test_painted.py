"""Materials that were painted over a run: read, checked, and taken by a training that goes on."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault
from heard import Heard
from PIL import Image

import polarguide
from polarguide.capture import load_scene
from polarguide.core.options import SceneOptions
from polarguide.recipes import RECIPES
from polarguide.runs.folder import RunConfiguration, RunLog
from polarguide.runs.painted import FOLDER, read_painted, write_painted
from polarguide.training.metals.search import looks
from polarguide.training.settings import TrainSettings
from polarguide_bench.plan import trained_steps

READING = SceneOptions(downscale=4)
STEPS = 60
# Looks for metals at step 51, too, in a training this short.
RECIPE = replace(RECIPES["polarguide-stokes"], metals=(0.0, 1.0))


@pytest.fixture(scope="module")
def scene(demo_scene: Path) -> polarguide.Scene:
    return load_scene(demo_scene, downscale=4)


def pictures(scene: polarguide.Scene, number: int = 2) -> dict[str, torch.Tensor]:
    """The middle of every training view is one material."""
    made = {}
    for view in scene.train_views:
        height, width = view.camera.height, view.camera.width
        made[view.name] = torch.zeros(height, width, dtype=torch.uint8)
        made[view.name][height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = number
    return made


def test_what_is_painted_counts_before_the_scenes_own_materials(
    scene: polarguide.Scene, tmp_path: Path
) -> None:
    assert read_painted(tmp_path, scene) is None
    write_painted(tmp_path, pictures(scene, 0))
    assert read_painted(tmp_path, scene) is None  # nothing is said
    write_painted(tmp_path, pictures(scene))
    painted = read_painted(tmp_path, scene)
    first, second = scene.train_views[:2]
    dielectric = torch.ones(first.camera.height, first.camera.width, dtype=torch.uint8)
    views = tuple(replace(v, materials=dielectric) if v is first else v for v in scene.views)
    over = painted.over(replace(scene, views=views))
    assert over.view(first.name).materials.unique().tolist() == [1, 2]
    assert over.view(second.name).materials.unique().tolist() == [0, 2]
    assert over.test_views[0].materials is None


def test_paint_on_a_held_out_view_is_refused(scene: polarguide.Scene, tmp_path: Path) -> None:
    test = scene.test_views[0]
    blank = torch.zeros(test.camera.height, test.camera.width, dtype=torch.uint8)
    write_painted(tmp_path, {**pictures(scene), test.name: blank})
    assert read_painted(tmp_path, scene) is not None  # says nothing
    write_painted(tmp_path, {test.name: blank + 2})
    Fault(f"{test.name}.png", "a training view", "held out").raised_by(read_painted, tmp_path, scene)


@pytest.mark.parametrize(
    ("name", "picture", "fault"),
    [
        ("stranger", np.zeros((2, 2), np.uint8), Fault("", "of the 14 views", "stranger")),
        ("v000", np.zeros((7, 9), np.uint8), Fault("v000.png", "size of the training view", "9x7")),
        ("v000", None, Fault("v000.png", "the numbers 0, 1, 2", "3")),
    ],
)
def test_pictures_that_do_not_suit_are_refused(
    scene: polarguide.Scene, tmp_path: Path, name: str, picture: np.ndarray | None, fault: Fault
) -> None:
    (tmp_path / FOLDER).mkdir()
    camera = scene.view("v000").camera
    numbers = np.full((camera.height, camera.width), 3, np.uint8) if picture is None else picture
    Image.fromarray(numbers).save(tmp_path / FOLDER / f"{name}.png")
    fault.raised_by(read_painted, tmp_path, scene)


@pytest.fixture(scope="module")
def finished(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, whose last look at metals is some steps before its end."""
    out = tmp_path_factory.mktemp("painted") / "run"
    train(demo_scene, out)
    return out


def train(scene: Path, out: Path, **options: object) -> polarguide.Run:
    return polarguide.train(
        scene, out, recipe=RECIPE, settings=TrainSettings(STEPS), reading=READING, **options
    )


def test_a_finished_training_goes_back_once_and_takes_what_was_painted(
    demo_scene: Path, scene: polarguide.Scene, finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    run = polarguide.open_run(out, recipe=RECIPE)
    assert looks(RECIPE, run.configuration.settings)[-1] == 51
    itself = float(run.gaussians["metalness"].mean())  # without a word of the user
    assert itself < 0.05
    write_painted(out, pictures(scene))
    told = Heard()
    again = train(demo_scene, out, resume=True, reporter=told)
    assert any("at step 51" in text for text in told.said)
    assert float(again.gaussians["metalness"].mean()) > 3 * itself
    assert trained_steps(out) == STEPS
    assert [row["step"] for row in RunLog(out).rows()] == list(range(9, STEPS, 10))
    assert RunConfiguration.load(out).painted == read_painted(out, scene).digest
    # Nothing has changed since: it is finished.
    before = (out / "checkpoint.safetensors").read_bytes()
    train(demo_scene, out, resume=True)
    assert (out / "checkpoint.safetensors").read_bytes() == before
    # Without the folder it goes back again, and looks for itself.
    shutil.rmtree(out / FOLDER)
    last = train(demo_scene, out, resume=True)
    assert RunConfiguration.load(out).painted is None
    assert float(last.gaussians["metalness"].mean()) <= itself


def test_a_training_that_is_not_so_far_goes_on(
    demo_scene: Path, scene: polarguide.Scene, tmp_path: Path
) -> None:
    out, stop = tmp_path / "run", iter((False,) * 3 + (True,)).__next__
    with pytest.raises(KeyboardInterrupt):
        train(demo_scene, out, should_stop=stop)
    write_painted(out, pictures(scene))
    told = Heard()
    run = train(demo_scene, out, resume=True, reporter=told)
    assert not any("at step" in text for text in told.said)
    assert float(run.gaussians["metalness"].mean()) > 0.1


@pytest.mark.parametrize(
    ("recipe", "settings"),
    [("3dgs", TrainSettings(8)), ("polarguide-stokes", TrainSettings(8, materials="dielectric"))],
)
def test_what_no_step_would_read_is_refused(
    demo_scene: Path, scene: polarguide.Scene, tmp_path: Path, recipe: str, settings: TrainSettings
) -> None:
    out = tmp_path / "run"
    polarguide.train(demo_scene, out, recipe=recipe, settings=settings, reading=READING)
    write_painted(out, pictures(scene))
    Fault(FOLDER, "search for metals", recipe).raised_by(
        polarguide.train, demo_scene, out, recipe=recipe, settings=settings, reading=READING, resume=True
    )


def test_materials_that_are_a_link_to_nowhere_are_refused(scene: polarguide.Scene, tmp_path: Path) -> None:
    (tmp_path / FOLDER).symlink_to("nowhere")
    Fault(str(tmp_path / FOLDER), found="nothing").raised_by(read_painted, tmp_path, scene)
