"""Verbs that write one thing: scale, tables, bench, synth, calibrate."""

from __future__ import annotations

import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from comparison_records import content
from comparison_records import run as run_record
from made_sensor import made_sensor, write_codes, write_polarizer_shots

from polarguide.capture.filter.ring_scale import ring_scale
from polarguide.cli.app import run
from polarguide.core.errors import install_extra
from polarguide.synth.schema import SceneSpec
from polarguide.synth.settings import Variant, choose_variant


def test_the_command_writes_it_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.svg"
    assert run(["scale", "--diameter", "70", "--out", str(out)]) == 0
    assert out.read_text() == ring_scale(70.0)
    assert run(["scale", "--diameter", "70", "--out", str(out)]) == 0
    assert run(["scale", "--diameter", "60", "--out", str(out)]) == 2
    assert "Give another --out" in capsys.readouterr().err
    assert out.read_text() == ring_scale(70.0)
    for wrong in ("nan", "3", "1000"):
        assert run(["scale", "--diameter", wrong, "--out", str(tmp_path / "b.svg")]) == 2
    assert "--diameter: expected 20 to 160" in capsys.readouterr().err


def test_the_folder_is_made(tmp_path: Path) -> None:
    out = tmp_path / "some" / "folder" / "a.svg"
    assert run(["scale", "--diameter", "70", "--out", str(out)]) == 0
    assert out.read_text() == ring_scale(70.0)


def test_wrong_input_of_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text(json.dumps(content([run_record("x", "3dgs", 0, psnr=30.0)])))
    (tmp_path / "y.json").write_text(json.dumps({"format": "polarguide-results-2"}))
    for arguments, said in (
        ([str(tmp_path / "none.json")], "none.json"),
        ([str(tmp_path)], "results.json"),
        ([str(tmp_path / "x.json"), str(tmp_path / "y.json")], "y.json"),
        ([str(tmp_path / "x.json"), "--against", "ref-gs"], "--against: expected one of 3dgs"),
        ([], "expected a record"),
    ):
        assert run(["tables", *arguments, "--out", str(tmp_path / "all")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert not (tmp_path / "all").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scenes", "rough"], "--scenes: expected scenes of the development half"),
        (["--scenes", "cat"], "--scenes: expected one of figure, kit, car, water"),
        (["--held-back", "--scenes", "kit"], "--scenes: expected one of metals-b, ceramic-b"),
        (["--threads", "0"], "--threads: expected 1 or more"),
        (["--jobs", "-1"], "--jobs: expected 0 or more"),
    ],
)
def test_refusals(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["bench", "--out", str(tmp_path / "x"), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("words", [["bench", "--render-only"], ["synth", "proof"]])
def test_without_mitsuba_the_extra_is_named(
    words: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert run([*words, "--out", str(tmp_path / "x")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"Install it with {install_extra('synth')} and" in line
    assert not (tmp_path / "x").exists()


class Keyboard(io.StringIO):
    """A terminal on which one line is typed."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("terminal", "options", "typed", "begun"),
    [
        (True, [], "\n", False),
        (True, [], "", False),
        (True, [], "y\n", True),
        (True, ["--yes"], "", True),
        (True, ["--size", "16x16", "--samples", "1"], "", True),
        (False, [], "", True),
        (True, ["--sweep", "noise=0,1"], "n\n", False),
    ],
)
def test_a_long_rendering_is_announced_and_asked_for_before_there_is_a_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    terminal: bool, options: list[str], typed: str, begun: bool,
) -> None:  # fmt: skip
    """Without LLVM the scene takes half a day; sixteen pixels each way with one path each do not."""
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    started: list[Path] = []

    def build(spec: SceneSpec, out: Path, variant: Variant) -> None:
        started.append(out)
        raise KeyboardInterrupt

    monkeypatch.setattr("polarguide.synth.settings._missing_llvm", lambda: "none was found")
    monkeypatch.setattr("polarguide.synth.render.build_scene", build)
    monkeypatch.setattr("sys.stdin", Keyboard(typed) if terminal else io.StringIO(typed))
    monkeypatch.setattr("polarguide.cli.console.console._force_terminal", terminal)
    out = tmp_path / "x"
    status = run(["synth", "proof", "--out", str(out), *options])
    choose_variant("rgb", threads=1)
    said = capsys.readouterr()
    assert "LLVM" in said.out
    told = re.search(r"Rendering will take about \d+ (\w+)", said.out)
    assert told is not None
    assert told[1] == ("minutes" if "--size" in options else "hours")
    assert status == (130 if begun else 2)
    assert (bool(started), out.exists()) == (begun, begun)
    assert ("expected yes to about" in said.err) != begun


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
        "Angles were estimated",
        "picture: camera.png",
    ):
        assert expected in said
    command = ["prepare", "raw", "--sensor", "IMX250MZR", "--poses", "none", "--bits", "12", "--out"]
    assert run([*command, "corrected", "--calibration", "camera.safetensors"]) == 0
    assert json.loads(Path("corrected/scene.json").read_text())["analyzers"]["lens"] == "12 mm"
    assert run([*command, "plain"]) == 0
    given = {"plain": ["--calibration", "camera.safetensors"], "corrected": []}
    found = {}
    for scene, more in given.items():
        assert run(["inspect", scene, "--out", f"{scene}-inspection", "--threads", "1", *more]) == 0
        record = json.loads(Path(f"{scene}-inspection/inspection.json").read_text())
        checks = {check["key"]: check for check in record["checks"]}
        assert checks["analyzers"]["verdict"] == "ok"
        assert "12 mm" in checks["analyzers"]["finding"]
        found[scene] = record["views"][0]["dolp"]["median"]
    true = np.hypot(0.06, 0.06) / 0.9
    assert found["plain"] == pytest.approx(true, abs=0.002)
    assert found["corrected"] == pytest.approx(true, abs=0.002)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["calibrate", "nowhere", "--out", "c.safetensors", "--sensor", "IMX250MZR"], "nowhere"),
        (["calibrate", ".", "--out", "../c.safetensors", "--sensor", "IMX250MZR"], "at least 5 shots"),
        (
            ["calibrate", ".", "--out", "c.png", "--sensor", "IMX250MZR"],
            "--out: expected a file name that ends in",
        ),
        (
            ["inspect", ".", "--fix", "new", "--calibration", "c.safetensors"],
            "--fix: expected no --calibration",
        ),
        (
            ["prepare", ".", "--out", "new", "--sensor", "IMX250MZR", "--calibration", "no.safetensors"],
            "found No such file",
        ),
        (["synth", "cat", "--out", "new"], "cat"),
        (["synth", "proof", "--size", "big", "--out", "new"], "--size"),
        (["synth", "proof", "--sweep", "size=1", "--out", "new"], "--sweep"),
    ],
)
def test_wrong_input_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    expected: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_codes(tmp_path / "v0.png", np.full((64, 64), 0.5))
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "new").exists()
