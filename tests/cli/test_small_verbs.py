"""Verbs that write one thing: scale, tables, bench, synth, calibrate."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_sensor import made_sensor, write_codes, write_polarizer_shots

from polarguide.cli.app import run
from polarguide.core.errors import install_extra
from polarguide.methods import recipe_named
from polarguide.runs.folder import CHECKPOINT, LOG
from polarguide.training.settings import TrainSettings
from polarguide_bench.options import CompareOptions
from polarguide_bench.plan import Comparison, plan_runs, scene_entries
from polarguide_bench.results import read_results
from polarguide_shots.ring_scale import ring_scale


def test_the_command_writes_it_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And makes the folder."""
    out = tmp_path / "some" / "folder" / "a.svg"
    assert run(["scale", "--diameter", "70", "--out", str(out)]) == 0
    assert out.read_text() == ring_scale(70.0)
    assert run(["scale", "--diameter", "70", "--out", str(out)]) == 0
    assert run(["scale", "--diameter", "60", "--out", str(out)]) == 2
    assert "Give another --out" in capsys.readouterr().err
    assert out.read_text() == ring_scale(70.0)


@pytest.mark.parametrize("words", [["bench", "--render-only"], ["synth", "proof"]])
def test_without_mitsuba_its_wheel_is_named(
    words: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert run([*words, "--out", str(tmp_path / "x")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"Install it with {install_extra('synth')} and" in line
    assert not (tmp_path / "x").exists()


def test_from_shots_to_a_corrected_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sensor = made_sensor(size=(96, 128))
    write_polarizer_shots(tmp_path, sensor, [15.0 * index for index in range(12)], black=240)
    write_codes(tmp_path / "raw" / "v0.png", sensor.sees(np.array([0.9, 0.06, 0.06])))
    options = ["--sensor", "IMX250MZR", "--dark-frame", "dark.png", "--flat", "flat.png", "--lens", "12 mm"]
    assert run(["calibrate", "shots", "--out", "camera.safetensors", *options, "--threads", "1"]) == 0
    said = capsys.readouterr().out
    for expected in (
        "polarizer at",
        "extinction ratio",
        "135 deg",
        "angles were estimated",
        "picture: camera.png",
    ):
        assert expected in said
    command = ["prepare", "raw", "--sensor", "IMX250MZR", "--poses", "none", "--bits", "12", "--out"]
    assert run([*command, "corrected", "--calibration", "camera.safetensors"]) == 0
    assert json.loads(Path("corrected/scene.json").read_text())["analyzers"]["lens"] == "12 mm"
    inspected = ["inspect", "corrected", "--out", "inspection", "--threads", "1"]
    assert run(inspected) == 0
    record = json.loads(Path("inspection/inspection.json").read_text())
    checks = {check["key"]: check for check in record["checks"]}
    assert checks["analyzers"]["verdict"] == "ok"
    assert "12 mm" in checks["analyzers"]["finding"]
    true = np.hypot(0.06, 0.06) / 0.9
    assert record["views"][0]["dolp"]["median"] == pytest.approx(true, abs=0.002)


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
    assert "1 failed runs (demo, 3dgs, seed 0: " in said.err
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
