"""A published dataset from the command line to a training run."""

from __future__ import annotations

from pathlib import Path

import pytest
from dataset_files import write_nersp

from polarguide.cli.app import run


def test_a_dataset_becomes_a_scene_that_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nersp(tmp_path / "in")
    source, scene, out = (str(tmp_path / name) for name in ("in", "scene", "run"))
    assert run(["prepare", source, "--out", scene, "--threads", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "4 views, format nersp" in printed
    assert "Four-angle sum check: n/a" in printed
    assert "Angles count clockwise as displayed (nersp; --sense and --zero say otherwise)" in printed
    assert "sampled at random in the hull of the masks" in printed
    assert run(["train", scene, "--out", out, "--steps", "2", "--threads", "1"]) == 0


def test_one_line_for_a_link_that_goes_nowhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nersp(tmp_path / "in")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for flags in (
        ["--poses", str(loop)],
        ["--format", "mosaic", "--sensor", "IMX250MZR", "--dark-frame", str(loop)],
    ):
        assert run(["prepare", str(tmp_path / "in"), "--out", str(tmp_path / "out"), *flags]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        assert not (tmp_path / "out").exists()
