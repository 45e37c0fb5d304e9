"""The refractive index of a run is the one asked for, else what the scene says, and stays the same when it goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import polarguide
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SceneOptions
from polarguide.core.progress import Reporter
from polarguide.core.system import MemoryBound
from polarguide.experiments.options import CompareOptions
from polarguide.recipes import recipe_named
from polarguide.runs import train as training
from polarguide.runs.folder import CONFIGURATION
from polarguide.runs.train import TrainingStopped
from polarguide.training.recipe import Schedule
from polarguide.training.settings import TrainSettings

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
    assert "refractive index 1.33, as scene.json says" in said.lines
    assert index_of(run) == 1.33
    with pytest.raises(PolarguideError, match=r"\(settings\)"):
        polarguide.train(
            water, run, settings=TrainSettings(3, refractive_index=1.5), reading=READING, resume=True
        )
    record = json.loads((run / CONFIGURATION).read_text())
    assert record["settings"]["background"] == "scene"
    # As the first versions recorded it.
    record["settings"]["background"] = "auto"
    (run / CONFIGURATION).write_text(json.dumps(record))
    opened = polarguide.train(water, run, settings=ASKED, reading=READING, resume=True)
    assert opened.steps == 3
    assert index_of(run) == 1.33
    assert opened.configuration.settings.background == "scene"


def test_without_settings_it_is_that_of_the_scene(water: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingStopped):
        polarguide.train(water, tmp_path / "run", reading=READING, should_stop=lambda: True)
    assert index_of(tmp_path / "run") == 1.33


def test_a_comparison_takes_it_too(water: Path, tmp_path: Path) -> None:
    options = CompareOptions(downscale=4, device="cpu", report_views=0)
    results = polarguide.compare([water], ["3dgs"], tmp_path, settings=TrainSettings(2), options=options)
    assert index_of(tmp_path / results.runs["folder"][0]) == 1.33
    assert results.record.settings.refractive_index is None
    assert results.record.scenes[0].refractive_index == 1.33


def test_one_that_is_asked_for_overrides_the_scene(water: Path, tmp_path: Path) -> None:
    settings = TrainSettings(1, refractive_index=1.6)
    polarguide.train(water, tmp_path / "run", settings=settings, reading=READING)
    assert index_of(tmp_path / "run") == 1.6


def test_a_run_that_records_none_is_refused(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    record = json.loads((trained / CONFIGURATION).read_text())
    record["settings"]["refractive_index"] = 0
    (tmp_path / "run" / CONFIGURATION).write_text(json.dumps(record))
    with pytest.raises(PolarguideError, match=r"refractive_index\): expected between 1 and 4, found 0"):
        polarguide.open_run(tmp_path / "run")


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

    monkeypatch.setattr(training, "MemoryBound", Bound)
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
    (limit,) = limits
    assert 10**8 < limit <= 2 << 30
