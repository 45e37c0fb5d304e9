"""What a run takes from its scene: the refractive index, and what is masked; it stays the same when it goes on."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from faults import Fault

import polarguide
from polarguide.capture import load_scene
from polarguide.core.options import SceneOptions
from polarguide.core.progress import Reporter
from polarguide.core.system import MemoryBound
from polarguide.methods import RECIPES, recipe_named
from polarguide.runs import callbacks as observers
from polarguide.runs import train as training
from polarguide.runs.callbacks import TrainingStopped
from polarguide.runs.folder import CONFIGURATION
from polarguide.training.recipe import Schedule
from polarguide.training.settings import TrainSettings
from polarguide_bench.options import CompareOptions
from polarguide_bench.plan import Comparison, plan_runs, scene_entries

READING = SceneOptions(downscale=4)
ASKED = TrainSettings(3)


@pytest.fixture
def water(demo_scene: Path, tmp_path: Path) -> Path:
    """The demo scene, as if all of it were water."""
    scene = tmp_path / "water"
    shutil.copytree(demo_scene, scene)
    about = scene / "scene.json"
    said = json.loads(about.read_text()) if about.exists() else {}
    about.write_text(json.dumps({**said, "refractive_index": 1.33}))
    return scene


def index_of(run: Path) -> float:
    return float(json.loads((run / CONFIGURATION).read_text())["settings"]["refractive_index"])


class Said(Reporter):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, message: str) -> None:
        self.lines.append(message)


def test_a_training_takes_the_index_of_its_scene_and_goes_on_with_it(water: Path, tmp_path: Path) -> None:
    run, said = tmp_path / "run", Said()
    stop = iter((False, False, True)).__next__
    with pytest.raises(TrainingStopped):
        polarguide.train(water, run, settings=ASKED, reading=READING, reporter=said, should_stop=stop)
    assert "refractive index 1.33 from scene.json" in said.lines
    assert index_of(run) == 1.33
    other = TrainSettings(3, refractive_index=1.5)
    Fault("(settings)").raised_by(polarguide.train, water, run, settings=other, reading=READING, resume=True)
    assert json.loads((run / CONFIGURATION).read_text())["settings"]["background"] == "scene"
    opened = polarguide.train(water, run, settings=ASKED, reading=READING, resume=True)
    assert opened.steps == 3
    assert index_of(run) == 1.33
    assert opened.configuration.settings.background == "scene"


def test_without_settings_it_is_that_of_the_scene(water: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingStopped):
        polarguide.train(water, tmp_path / "run", reading=READING, should_stop=lambda: True)
    assert index_of(tmp_path / "run") == 1.33


def test_a_comparison_takes_it_too(water: Path, tmp_path: Path) -> None:
    options = CompareOptions(downscale=4, device="cpu")
    comparison = Comparison((water,), (RECIPES["3dgs"],), TrainSettings(2), options, tmp_path)
    scenes = scene_entries(comparison)
    assert scenes[0].refractive_index == 1.33
    (planned,) = plan_runs(comparison, scenes)
    assert planned.settings.refractive_index == 1.33


def test_one_that_is_asked_for_overrides_the_scene(water: Path, tmp_path: Path) -> None:
    settings = TrainSettings(1, refractive_index=1.6)
    polarguide.train(water, tmp_path / "run", settings=settings, reading=READING)
    assert index_of(tmp_path / "run") == 1.6


def test_a_run_that_records_none_is_refused(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    record = json.loads((trained / CONFIGURATION).read_text())
    record["settings"]["refractive_index"] = 0
    (tmp_path / "run" / CONFIGURATION).write_text(json.dumps(record))
    Fault("refractive_index)", "1 and 4", "0").raised_by(polarguide.open_run, tmp_path / "run")


def test_shots_of_a_scene_without_poses_have_its_index(water: Path, tmp_path: Path) -> None:
    shutil.rmtree(water / "sparse")
    for index, expected in ((None, 1.33), (1.4, 1.4)):
        out = tmp_path / f"maps {index}"
        found = polarguide.shot_priors(water, out, refractive_index=index, formats=["npy"])
        (record, *_) = (
            path for path in sorted(out.rglob("*.json")) if "refractive_index" in path.read_text()
        )
        assert json.loads(record.read_text())["refractive_index"] == expected
        assert found is not None


def test_a_training_keeps_within_its_memory_after_every_step(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits: list[float] = []
    cleared: list[int] = []
    steps, every = 0, 10

    class Bound(MemoryBound):
        def __init__(self, limit: float) -> None:
            limits.append(limit)

        def keep(self) -> None:
            nonlocal steps
            steps += 1

        def clear(self) -> None:
            cleared.append(steps)

    for module in (training, observers):
        monkeypatch.setattr(module, "MemoryBound", Bound)
    run = polarguide.train(
        demo_scene, tmp_path / "run", settings=TrainSettings(every), reading=SceneOptions(4, memory=2.0)
    )
    assert steps == every
    # A guided step makes the targets of a view that had none. Each view is looked at after the last step with density
    # control, and before the last stage.
    schedule = Schedule(recipe_named("polarguide-stokes"), every)
    times = [cleared.count(step) for step in range(every)]
    views = len(run.scene.train_views)
    looks = {max(step for step in range(every) if schedule.at(step).stage.densify)}
    looks |= {step for step in range(every) if "orient_normals" in schedule.at(step).actions}
    assert times[0] == 0
    assert all(times[step] >= 2 for step in range(1, every))
    assert all((times[step] >= views + 2) == (step in looks) for step in range(2, every))
    limit = limits[0]
    assert limits == [limit, limit]
    assert 10**8 < limit <= 2 << 30


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
        assert not bool(view.codes.int()[:, ~mask].any())
        assert bool((view.codes.int() == whole.view(view.name).codes.int())[:, mask].all())
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["background"] == "masked"


def test_a_scene_without_masks_is_refused_before_anything_is_written(
    demo_scene: Path, tmp_path: Path
) -> None:
    Fault(expected="a mask of every view").raised_by(
        polarguide.train, demo_scene, tmp_path / "run", settings=MASKED, reading=READING
    )
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
    Fault("test_views").raised_by(polarguide.train, scene, tmp_path / "directions", **again)


def test_a_run_that_records_no_test_views_is_refused(trained: Path, tmp_path: Path) -> None:
    """As runs of versions before 0.2."""
    shutil.copytree(trained, tmp_path / "run")
    record = json.loads((trained / CONFIGURATION).read_text())
    del record["test_views"]
    (tmp_path / "run" / CONFIGURATION).write_text(json.dumps(record))
    Fault("run.json", "the field test_views").raised_by(polarguide.open_run, tmp_path / "run")
