"""``polarguide tables`` with wrong input: one line, and nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from comparison_records import content, run

from polarguide.cli.app import run as command


def test_wrong_input_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text(json.dumps(content([run("x", "3dgs", 0, psnr=30.0)])))
    (tmp_path / "y.json").write_text(json.dumps({"format": "polarguide-results-2"}))
    for arguments, said in (
        ([str(tmp_path / "none.json")], "none.json"),
        ([str(tmp_path)], "results.json"),
        ([str(tmp_path / "x.json"), str(tmp_path / "y.json")], "y.json"),
        ([str(tmp_path / "x.json"), "--against", "ref-gs"], "--against: expected one of 3dgs"),
        ([], "expected a record"),
    ):
        assert command(["tables", *arguments, "--out", str(tmp_path / "all")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert not (tmp_path / "all").exists()
