"""``polarguide synth`` with wrong input, and without its extra."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from polarguide.cli.app import run


def test_without_mitsuba_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert run(["synth", "proof", "--out", str(tmp_path / "x")]) == 2
    assert "polarguide[synth]" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["cat"], ["proof", "--size", "big"], ["proof", "--sweep", "size=1"]])
def test_wrong_input_is_one_line(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["synth", *arguments, "--out", str(tmp_path / "x")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
