"""``polarguide synth`` with wrong input, and without its extra."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.installation import install_extra
from polarguide.synth.schema import SceneSpec
from polarguide.synth.settings import Variant, choose_variant


def test_without_mitsuba_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert run(["synth", "proof", "--out", str(tmp_path / "x")]) == 2
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


@pytest.mark.parametrize("arguments", [["cat"], ["proof", "--size", "big"], ["proof", "--sweep", "size=1"]])
def test_wrong_input_is_one_line(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["synth", *arguments, "--out", str(tmp_path / "x")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
