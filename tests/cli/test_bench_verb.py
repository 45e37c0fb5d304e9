"""``polarguide bench`` with wrong input: one line, and nothing is written."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.installation import install_extra


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


def test_without_mitsuba_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert run(["bench", "--render-only", "--out", str(tmp_path / "x")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"Install it with {install_extra('synth')} and" in line
    assert not (tmp_path / "x").exists()
