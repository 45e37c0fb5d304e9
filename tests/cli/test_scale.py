"""``polarguide scale``."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.capture.filter.ring_scale import ring_scale
from polarguide.cli.app import run


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
