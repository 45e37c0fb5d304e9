"""Metrics and loss terms of packages that are installed: the example of the docs, and packages that are broken."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tomllib
import torch
from plugins import install

from polarguide.core.errors import PolarguideWarning
from polarguide.results.evaluation.metric import GROUP, plugged_metrics

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "write-a-plugin.md"


def test_the_example_of_the_docs(demo_scene: Path, tmp_path: Path) -> None:
    """Installed as pip would: its module and its metadata on the path of other processes."""
    page = PAGE.read_text()
    blocks = dict(re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```", page, re.DOTALL | re.MULTILINE))
    assert blocks.keys() == {"pyproject.toml", "less_shine.py"}
    (tmp_path / "less_shine.py").write_text(blocks["less_shine.py"])
    data = tmp_path / "less_shine-1.0.dist-info"
    data.mkdir()
    (data / "METADATA").write_text("Metadata-Version: 2.1\nName: less-shine\nVersion: 1.0\n")
    groups = tomllib.loads(blocks["pyproject.toml"])["project"]["entry-points"]
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in e.items()) for group, e in groups.items()]
    (data / "entry_points.txt").write_text("".join(lines))
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])

    def python(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments],
            env={**os.environ, "PYTHONPATH": paths, "COLUMNS": "160"},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout

    run = tmp_path / "run"
    short = ("--downscale", "8", "--steps", "8", "--threads", "1")
    program = ("-m", "polarguide")
    python(*program, "train", str(demo_scene), "--out", str(run), "--recipe", "less-shine", *short)
    weights = [
        stage["weights"] for stage in json.loads((run / "run.json").read_text())["recipe_data"]["stages"]
    ]
    assert [each["strength"] for each in weights] == [0.05] * len(weights)
    shown = python(*program, "eval", str(run), "--no-speed", "--threads", "1")
    value = json.loads((run / "metrics.json").read_text())["highlight_error"]
    assert 0 < value < 1
    assert re.search(rf"highlight error\W+{100 * value:.3f} %", shown)
    columns = "from polarguide.results.evaluation.table import COLUMNS; print(COLUMNS[-1].heading)"
    assert python("-c", f"import less_shine; {columns}").strip() == "highlight error (%) ↓"


MODULE = """
from polarguide.results.evaluation.metric import Metric
def measure(target, layers):
    return None
GOOD = Metric("good", "good", "", 1, "lower", measure=measure)
TAKEN = Metric("psnr", "mine", "", 1, "lower", measure=measure)
OF_RUN = Metric("late", "late", "", 1, None, of="run")
STRANGE = Metric("two words", "x", "", 1, None, measure=measure)
NUMBERED = Metric(7, "x", "", 1, None, measure=measure)
UNTITLED = Metric("untitled", None, "", 1, None, measure=measure)
DIGITS = Metric("digits", "x", "", -1, None, measure=measure)
SIDE = Metric("side", "x", "", 1, "up", measure=measure)
def ends(): raise SystemExit(0)
SEVERAL = lambda: [GOOD, Metric("best", "best", "", 1, None, measure=measure)]
"""


@pytest.mark.parametrize(
    ("entries", "keys", "complaint"),
    [
        ({"a": "GOOD"}, ["good"], None),
        ({"a": "SEVERAL"}, ["best", "good"], None),
        ({"a": "GOOD", "b": "GOOD"}, ["good"], "good"),
        ({"a": "TAKEN", "b": "GOOD"}, ["good"], "psnr"),
        ({"a": "OF_RUN"}, [], "'late'"),
        ({"a": "STRANGE"}, [], "'two words'"),
        ({"a": "MISSING", "b": "GOOD"}, ["good"], "AttributeError"),
        ({"a": "measure"}, [], "TypeError"),
        ({"a": "NUMBERED", "b": "GOOD"}, ["good"], "found 7"),
        ({"a": "UNTITLED"}, [], "untitled (label): expected text"),
        ({"a": "DIGITS"}, [], "digits (digits): expected 0 to 10, found -1"),
        ({"a": "SIDE"}, [], "side (better): expected higher or lower"),
        ({"a": "ends"}, [], "SystemExit: 0"),
    ],
)
def test_what_packages_offer(
    entries: dict[str, str],
    keys: list[str],
    complaint: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "offered_metrics.py").write_text(MODULE)
    places = {name: f"offered_metrics:{place}" for name, place in entries.items()}
    install(monkeypatch, tmp_path, GROUP, **places)
    monkeypatch.delitem(sys.modules, "offered_metrics", raising=False)
    if complaint is None:
        assert [metric.key for metric in plugged_metrics({"psnr"})] == keys
        return
    with pytest.warns(PolarguideWarning, match=re.escape(complaint)):
        assert [metric.key for metric in plugged_metrics({"psnr"})] == keys


MEASURES = """
import torch
from polarguide.results.evaluation.metric import Metric
def raising(target, layers):
    raise KeyError("albedo")
def exiting(target, layers):
    raise SystemExit(0)
def per_pixel(target, layers):
    return layers["final"]
def texts(target, layers):
    return "good"
def half(target, layers):
    return torch.tensor(0.5)
def metric(measure):
    return Metric("mine", "[/b]", "", 1, "lower", measure=measure)
RAISING, EXITING, PER_PIXEL, TEXTS, HALF = map(metric, (raising, exiting, per_pixel, texts, half))
"""


@pytest.mark.parametrize(
    ("place", "value", "complaint"),
    [
        ("RAISING", None, "KeyError: 'albedo'"),
        ("EXITING", None, "SystemExit: 0"),
        ("PER_PIXEL", None, "a tensor [4, 5, 3]"),
        ("TEXTS", None, "found str"),
        ("HALF", 0.5, None),
    ],
)
def test_a_measure_that_fails_has_no_value(
    place: str, value: float | None, complaint: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "offered_measures.py").write_text(MEASURES)
    install(monkeypatch, tmp_path, GROUP, mine=f"offered_measures:{place}")
    monkeypatch.delitem(sys.modules, "offered_measures", raising=False)
    (metric,) = plugged_metrics(())
    target: Any = SimpleNamespace(photograph=torch.zeros(4, 5, 3))
    layers = {"final": torch.zeros(4, 5, 3)}
    assert metric.measure is not None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):  # each view is scored, one warning is enough
            assert metric.measure(target, layers) == value
    assert [complaint in str(warning.message) for warning in caught] == ([] if complaint is None else [True])
