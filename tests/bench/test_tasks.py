"""Tasks of a run by its state, and the validity of its speeds."""

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from heard import Heard

from polarguide.core.options import ComputeOptions, SceneOptions
from polarguide.methods import recipe_named
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.runs.opened import OpenedRun
from polarguide.training.settings import TrainSettings
from polarguide_bench import compare as comparing
from polarguide_bench.children import Scoring, Training
from polarguide_bench.compare import BESIDE_OTHERS, collect
from polarguide_bench.job_queue import Job, Workers
from polarguide_bench.options import CompareOptions
from polarguide_bench.plan import (
    Comparison,
    PlannedRun,
    SceneEntry,
    plan_runs,
    scene_entries,
)
from polarguide_bench.results import PartScores
from polarguide_bench.tables import write_tables

Planned = tuple[Comparison, list[SceneEntry], PlannedRun]


@pytest.fixture
def planned(demo_scene: Path, tmp_path: Path) -> Planned:
    """Return a comparison with one new run."""
    question = Comparison(
        scenes=(demo_scene,),
        recipes=(recipe_named("polarguide-stokes"),),
        settings=TrainSettings(40, 0),
        options=CompareOptions(downscale=4, device="cpu", jobs=1, speed=True, report_views=0),
        out=tmp_path,
    )
    scenes = scene_entries(question)
    (only,) = plan_runs(question, scenes)
    return question, scenes, only


def score(folder: Path, **changes: Any) -> None:
    """Score a run and change its record."""
    evaluate(OpenedRun.open(folder))
    path = folder / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_new_run_is_trained_and_scored(planned: Planned) -> None:
    question, _, only = planned
    train, scoring = comparing._job(question, only, alone=True).tasks()
    assert isinstance(train, Training)
    assert (train.scene, train.folder) == (str(question.scenes[0]), str(only.folder))
    asked = dataclasses.replace(question.settings, refractive_index=1.5)  # the scene names none
    assert (train.settings, train.reading) == (asked, SceneOptions(4, "linear"))
    assert scoring == Scoring(folder=str(only.folder), speed=True, compute=ComputeOptions(1, "cpu"))
    assert not only.folder.exists()


def test_beside_others_no_speed_is_measured_and_that_is_remembered(planned: Planned) -> None:
    question, _, only = planned
    _, scoring = comparing._job(question, only, alone=False).tasks()
    assert isinstance(scoring, Scoring)
    assert not scoring.speed
    assert (only.folder / BESIDE_OTHERS).exists()


def test_a_run_is_gone_on_with_where_it_stopped(planned: Planned, trained: Path) -> None:
    question, _, only = planned
    shutil.copytree(trained, only.folder)
    assert [type(task) for task in comparing._job(question, only, alone=True).tasks()] == [Scoring]
    (only.folder / "point_cloud.ply").unlink()
    assert [type(task) for task in comparing._job(question, only, alone=True).tasks()] == [Training, Scoring]


def test_seconds_count_only_alone(planned: Planned, trained: Path) -> None:
    question, scenes, only = planned
    shutil.copytree(trained, only.folder)
    score(only.folder, train_seconds=12.5, fps=60.0)
    names = ["state", "train_seconds", "fps"]
    runs = collect(question, scenes, [only], {}).runs
    assert runs[names].iloc[0].tolist() == ["done", 12.5, 60.0]
    (only.folder / BESIDE_OTHERS).touch()
    (run,) = collect(question, scenes, [only], {only.folder: "an old error"}).record.runs
    assert (run.metrics["train_seconds"], run.metrics["fps"], run.error) == (None, 60.0, None)


def test_objects_and_materials_are_collected(planned: Planned, trained: Path) -> None:
    question, scenes, only = planned
    shutil.copytree(trained, only.folder)
    score(only.folder, objects={}, materials={})
    record = collect(question, scenes, [only], {}).record
    assert (record.runs[0].objects, record.runs[0].materials) == ({}, {})
    values = {
        "psnr": 20.0, "normal_mae_deg": None, "specular_psnr": None, "diffuse_psnr": 30.0, "stokes_error": 0.5,
    }  # fmt: skip
    scores = {"pixels": 7, "views": 1, **values}
    score(only.folder, objects={"ball": {"material": "metal", **scores}}, materials={"metal": scores})
    (run,) = collect(question, scenes, [only], {}).record.runs
    assert run.objects == {"ball": PartScores("metal", 7, 1, values)}
    assert run.materials == {"metal": PartScores(None, 7, 1, values)}
    # Files of an earlier comparison in the folder are removed.
    (question.out / "differences.csv").touch()
    write_tables(question.out, collect(question, scenes, [only], {}))
    assert sorted(path.name for path in question.out.glob("*.*")) == [
        "parts.csv", "results.csv", "results.json", "results.md", "results.tex",
    ]  # fmt: skip


def test_speed_times_what_was_not_timed(
    planned: Planned, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    question, _, only = planned
    shutil.copytree(trained, only.folder)
    asked: list[Job] = []

    def instead(jobs: Sequence[Job], at: Workers, **_: Any) -> None:
        assert at.most == 1
        asked.extend(jobs)

    monkeypatch.setattr(comparing, "run_jobs", instead)
    score(only.folder, fps=60.0)
    reporter = Heard()
    comparing._time(question, [only], reporter)
    assert asked == []
    score(only.folder)
    comparing._time(question, [only], reporter)
    scoring = Scoring(folder=str(only.folder), speed=True, compute=ComputeOptions(1, "cpu"))
    assert [job.tasks() for job in asked] == [(scoring,)]
    assert [text.partition(":")[0] for text in reporter.said][-1:] == ["no speed for 1 runs"]
