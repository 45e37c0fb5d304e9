"""``polarguide calibrate``, and its file as ``--calibration`` of ``prepare`` and ``inspect``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_sensor import made_sensor, write_codes, write_polarizer_shots

from polarguide.cli.app import run


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
