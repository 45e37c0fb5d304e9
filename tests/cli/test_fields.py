"""A run of a field on the command line: trained, scored, rendered, exported; steps of its own in a comparison."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.cli.compare import chosen_steps
from polarguide.errors import PolarguideError
from polarguide.experiments.record import read_results

SMALL = ["--downscale", "8", "--threads", "1"]


def test_steps_of_recipes() -> None:
    assert chosen_steps(("5000",)) == (5000, {})
    assert chosen_steps(("5000", "gnerp=10000")) == (5000, {"gnerp": 10000})
    assert chosen_steps(("gnerp:circular=7",)) == (None, {"gnerp:circular": 7})


@pytest.mark.parametrize("words", [("5000", "3000"), ("gnerp=",), ("gnerp=1", "gnerp=2"), ("many",), ("-5",)])
def test_steps_that_cannot_be_read(words: tuple[str, ...]) -> None:
    with pytest.raises(PolarguideError, match="--steps"):
        chosen_steps(words)


def test_steps_of_a_recipe_that_is_not_compared(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(demo_scene), "--recipes", "3dgs", "--steps", "5", "gnerp=9", "--out", str(out)]
    assert run(command) == 2
    assert "gnerp" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_a_field_is_compared_with_gaussians(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(demo_scene), "--recipes", "3dgs", "gnerp", "--steps", "20", "gnerp=4"]
    command += ["--downscale", "8", "--jobs", "1", "--out", str(out), "--report-views", "1"]
    assert run(command) == 0
    record = json.loads((out / "results.json").read_text())
    read_results(out / "results.json")
    assert [r["about"].endswith("; 4 steps.") for r in record["recipes"]] == [False, True]
    assert [r.get("steps") for r in record["recipes"]] == [None, 4]
    rows = [
        line.split("|")[1].strip() for line in (out / "results.md").read_text().splitlines() if "|" in line
    ]
    assert rows[2:4] == ["`3dgs`", "`gnerp` (4 steps)"]
    steps = {
        r["recipe"]: json.loads((out / r["folder"] / "metrics.json").read_text())["steps"]
        for r in record["runs"]
    }
    assert steps == {"3dgs": 20, "gnerp": 4}
    capsys.readouterr()
    assert run(command) == 0
    assert "finished before: 2" in capsys.readouterr().out
    folder = next(str(out / r["folder"]) for r in record["runs"] if r["recipe"] == "gnerp")
    assert (
        run(["render", folder, "--layers", "final,normal,depth,specular", "--out", str(tmp_path / "r")]) == 0
    )
    assert "no layer specular" in capsys.readouterr().out
    assert run(["export", folder, "--format", "mesh", "--resolution", "24"]) == 0
    for refused in (["export", folder, "--format", "ply"], ["share", folder]):
        capsys.readouterr()
        assert run(refused) == 2
        error = capsys.readouterr().err
        assert "signed-distance field" in error
        assert len(error.splitlines()) == 1
