"""What is done for a run by how far it is, and which of its speeds count."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from polarguide.cli import compare as verb
from polarguide.cli.app import run
from polarguide.experiments.collect import BESIDE_OTHERS, collect
from polarguide.experiments.jobs import Job
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry, plan_runs, scene_entries
from polarguide.recipes import recipe_named
from polarguide.training.trainer import TrainSettings

Planned = tuple[Comparison, list[SceneEntry], PlannedRun]


@pytest.fixture
def planned(demo_scene: Path, tmp_path: Path) -> Planned:
    """A comparison with one run, of which nothing is there yet."""
    question = Comparison(
        scenes=(demo_scene,),
        recipes=(recipe_named("polarguide-stokes"),),
        settings=TrainSettings(40, 0),
        seeds=1,
        downscale=4,
        transfer="linear",
        device="cpu",
        jobs=1,
        threads=1,
        speed=True,
        report_views=0,
        out=tmp_path,
    )
    scenes = scene_entries(question)
    (only,) = plan_runs(question, scenes)
    return question, scenes, only


def score(folder: Path, **changes: Any) -> None:
    """Score a run and change its record."""
    assert run(["eval", str(folder), "--no-speed", "--threads", "1"]) == 0
    path = folder / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_new_run_is_trained_and_scored(planned: Planned) -> None:
    question, _, only = planned
    train, scoring = verb._job(question, only, alone=True).commands
    assert train[:4] == ("train", str(question.scenes[0]), "--out", str(only.folder))
    assert "--resume" not in train
    assert scoring[:3] == ("eval", str(only.folder), "--speed")
    assert not only.folder.exists()


def test_beside_others_no_speed_is_measured_and_that_is_remembered(planned: Planned) -> None:
    question, _, only = planned
    _, scoring = verb._job(question, only, alone=False).commands
    assert "--no-speed" in scoring
    assert (only.folder / BESIDE_OTHERS).exists()


def test_a_run_is_gone_on_with_where_it_stopped(planned: Planned, trained: Path) -> None:
    question, _, only = planned
    shutil.copytree(trained, only.folder)
    assert [words[0] for words in verb._job(question, only, alone=True).commands] == ["eval"]
    (only.folder / "point_cloud.ply").unlink()
    train, _ = verb._job(question, only, alone=True).commands
    assert train[-1] == "--resume"


def test_seconds_count_only_alone(planned: Planned, trained: Path) -> None:
    question, scenes, only = planned
    shutil.copytree(trained, only.folder)
    score(only.folder, train_seconds=12.5, fps=60.0)
    (record,) = collect(question, scenes, [only], {})["runs"]
    assert (record["state"], record["metrics"]["train_seconds"], record["metrics"]["fps"]) == (
        "done",
        12.5,
        60.0,
    )
    (only.folder / BESIDE_OTHERS).touch()
    (record,) = collect(question, scenes, [only], {only.folder: "an old error"})["runs"]
    assert (record["metrics"]["train_seconds"], record["metrics"]["fps"]) == (None, 60.0)
    assert record["error"] is None


def test_speed_times_what_was_not_timed(
    planned: Planned, trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    question, _, only = planned
    shutil.copytree(trained, only.folder)
    asked: list[Job] = []

    def instead(jobs: Sequence[Job], *, parallel: int, **_: Any) -> None:
        assert parallel == 1
        asked.extend(jobs)

    monkeypatch.setattr(verb, "run_jobs", instead)
    score(only.folder, fps=60.0)
    verb._time(question, [only])
    assert asked == []
    score(only.folder)
    verb._time(question, [only])
    assert [job.commands for job in asked] == [(("eval", str(only.folder), "--speed", "--device", "cpu"),)]
    assert "no speed for 1 runs" in capsys.readouterr().out
