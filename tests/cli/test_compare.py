"""``polarguide compare`` from its first interruption to its last report, and what it refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.experiments.options import CompareOptions
from polarguide.experiments.plan import Comparison, plan_runs, scene_entries
from polarguide.experiments.record import read_results
from polarguide.recipes import recipe_named
from polarguide.runs.folder import CHECKPOINT, LOG
from polarguide.training.settings import TrainSettings

PATIENCE = 120.0
FLAGS = ("--steps", "200", "--downscale", "8", "--jobs", "1", "--recipes", "3dgs-dr")


def planned_folders(scene: Path, out: Path) -> list[Path]:
    """The run folders of the comparison of ``FLAGS`` and 3dgs."""
    question = Comparison(
        scenes=(scene,),
        recipes=(recipe_named("3dgs-dr"), recipe_named("3dgs")),
        settings=TrainSettings(200, 0),
        options=CompareOptions(downscale=8),
        out=out,
    )
    return [planned.folder for planned in plan_runs(question, scene_entries(question))]


@pytest.mark.slow
def test_interrupted_failed_and_finished(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    alone = ["compare", str(demo_scene), "--out", str(out), *FLAGS]
    command = [*alone, "3dgs"]

    # Ctrl-C while the first run trains: its state is saved, and nobody is left at work.
    process = subprocess.Popen(
        [sys.executable, "-m", "polarguide", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    give_up = time.monotonic() + PATIENCE
    while not list(out.rglob(LOG)) and time.monotonic() < give_up:
        assert process.poll() is None
        time.sleep(0.01)
    # Another comparison in the same folder is turned away meanwhile.
    assert run(command) == 2
    assert "another comparison at work in it" in capsys.readouterr().err
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 130
    (first,) = (path.parent for path in out.rglob(CHECKPOINT))
    assert not (first / "metrics.json").exists()
    before = [json.loads(line) for line in (first / LOG).read_text().splitlines()]

    # The same command goes on with it. The second run cannot work: its folder holds something else.
    (second,) = (folder for folder in planned_folders(demo_scene, out) if folder != first)
    second.mkdir(parents=True)
    (second / "run.json").write_text("{}")
    assert run(command) == 2
    said = capsys.readouterr()
    assert "expected 2 finished runs, found that 1 failed (demo, 3dgs, seed 0: " in said.err
    assert f"{second}/run.json: expected " in said.err
    assert len(said.err.splitlines()) == 1
    assert "done  demo, 3dgs-dr, seed 0" in said.out
    assert [r.state for r in read_results(out / "results.json").runs] == ["done", "failed"]
    lines = [json.loads(line) for line in (first / LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(9, 200, 10))
    assert lines[: len(before)] == before, "it went on instead of starting over"
    assert "| `3dgs` (failed) |  |" in (out / "results.md").read_text()

    # What is finished is not done again, in a comparison with other recipes neither.
    stamp = (first / "metrics.json").stat().st_mtime_ns
    assert run(alone) == 0
    assert "runs: 1, of them finished before: 1" in capsys.readouterr().out
    assert (first / "metrics.json").stat().st_mtime_ns == stamp
    record = json.loads((out / "results.json").read_text())
    assert [r["state"] for r in record["runs"]] == ["done"]
    with open(out / "results.csv") as file:
        (row,) = csv.DictReader(file)
    assert float(row["specular_psnr"]) == record["runs"][0]["metrics"]["specular_psnr"]
    assert "\\toprule" in (out / "results.tex").read_text()
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 3 * 2  # the true and the rendered normals of three views
    assert page.count("data:image/jpeg") == 3 * (3 + 5)
    assert not list(out.glob(".*.tmp"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--recipes", "magic"], "recipe: expected one of"),
        (["--recipes", "3dgs", "3dgs"], "--recipes: expected every name once"),
        (["--recipes", "3dgs", "--steps", "0"], "--steps: expected 1 or more"),
        (["--recipes", "3dgs", "--seeds", "0"], "--seeds: expected 1 or more"),
        (["--recipes", "3dgs", "--threads", "0"], "--threads: expected 1 or more"),
        (["--recipes", "3dgs", "--jobs", "-1"], "--jobs: expected"),
        (["--recipes", "3dgs", "--report-views", "-1"], "--report-views: expected"),
        (["--recipes", "3dgs", "--refractive-index", "5"], "--refractive-index"),
        (["--recipes", "3dgs", "--device", "cuda"], "--device cuda"),
        (["--recipes", "3dgs", "--downscale", "0"], "downscale: expected"),
    ],
)
def test_refusals(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert run(["compare", str(demo_scene), *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_two_scenes_of_one_name_are_refused(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["compare", str(demo_scene), str(demo_scene), "--recipes", "3dgs", "--downscale", "8"]
    assert run([*command, "--out", str(tmp_path / "out")]) == 2
    assert "expected scenes with names of their own, found demo twice" in capsys.readouterr().err
