"""``polarguide train --memory``: too little is refused at once, and enough gives the same bits as plenty."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from safetensors.torch import load_file

from polarguide.cli.app import run
from polarguide.runs import families
from polarguide.runs import forecast as forecasts
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION
from polarguide.runs.forecast import MemoryPlan

SHORT = ("--downscale", "4", "--steps", "30", "--threads", "1")


def test_too_little_is_refused_before_a_picture_is_decoded(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object) -> None:
        raise AssertionError("a picture was decoded")

    monkeypatch.setattr("polarguide.capture.view_reader.decode_picture", decode)
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "run"), *SHORT, "--memory", "30MB"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--memory: expected at least" in said
    assert "Give --memory" in said
    assert not (tmp_path / "run").exists()


def test_a_training_in_little_memory_gives_the_same_bits_and_says_what_it_takes(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecasts, "LEAST_STEPS", 30)
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "a"), *SHORT]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(
        r"estimate: \d+ s with the [\d,]+ Gaussians of the beginning, \d+ s with [\d,]+; up to", said
    )
    assert re.search(
        r"took \d+ s and [\d.]+ GB of memory \(estimate: \d+ s( to \d+ s)?, up to [\d.]+ GB\)", said
    )
    # Nothing is kept in memory.
    monkeypatch.setattr(families, "plan_memory", lambda *_, **__: MemoryPlan(False, 0, 10**9))
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "b"), *SHORT, "--memory", "3GB"]) == 0
    first, second = (load_file(tmp_path / name / CHECKPOINT) for name in "ab")
    assert first.keys() == second.keys()
    assert all(first[name].numpy().tobytes() == second[name].numpy().tobytes() for name in first)
    assert {path.name for path in (tmp_path / "b").iterdir()} == {
        path.name for path in (tmp_path / "a").iterdir()
    }
    settings = json.loads((tmp_path / "b" / CONFIGURATION).read_text())["settings"]
    assert settings["steps"] == 30
    assert settings["gaussians"] > 1000
