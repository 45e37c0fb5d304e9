"""``compare --exposures``: rows, run folders, and the figure."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from polarguide import PolarguideError
from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.exposure_figure import exposure_svg
from polarguide.experiments.options import CompareOptions
from polarguide.experiments.plan import Comparison, SceneEntry, plan_runs
from polarguide.recipes import recipe_named
from polarguide.training.settings import TrainSettings

SCENE = SceneEntry(Path("cup"), "cup", "abc", 72, tuple(f"v{k}" for k in range(9)))


def comparison(*recipes: str, exposures: tuple[str, ...] = ("four", "one", "none")) -> Comparison:
    return Comparison(
        (SCENE.path,),
        tuple(recipe_named(name) for name in recipes),
        TrainSettings(steps=10),
        CompareOptions(exposures=exposures),  # type: ignore[arg-type]
        Path("out"),
    )


def test_rows_and_folders_are_named_by_the_words() -> None:
    asked = comparison("polarguide-stokes")
    plan = plan_runs(asked, [SCENE])
    assert [row.name for row in asked.rows] == ["four", "one", "none"]
    assert [run.folder.parent.name for run in plan] == ["four", "one", "none"]
    assert [run.settings.exposures for run in plan] == ["four", "one", "none"]
    assert [run.recipe.name for run in plan] == [
        "polarguide-stokes",
        "polarguide-stokes",
        "polarguide-stokes:unpolarized",
    ]
    assert len({run.folder.name for run in plan}) == 3
    assert asked.command.endswith("--exposures four one none")


def test_several_recipes_have_a_row_for_each_word() -> None:
    names = [row.name for row in comparison("3dgs", "polarguide-stokes", exposures=("one", "none")).rows]
    assert names == ["3dgs one", "3dgs none", "polarguide-stokes one", "polarguide-stokes none"]


def test_without_words_nothing_changes() -> None:
    asked = comparison("polarguide-stokes", exposures=())
    (run,) = plan_runs(asked, [SCENE])
    assert (run.row.name, run.settings.exposures) == ("polarguide-stokes", "captured")
    assert "--exposures" not in asked.command


def test_words_are_checked() -> None:
    with pytest.raises(PolarguideError, match="exposures: expected every word once"):
        CompareOptions(exposures=("one", "one"))
    with pytest.raises(PolarguideError, match="exposures: expected one of captured, four"):
        CompareOptions(exposures=("five",))  # type: ignore[arg-type]


def test_the_figure_has_a_point_for_each_row() -> None:
    cells = {metric.key: {"mean": 20.0 + k} for k, metric in enumerate(COLUMNS)}
    rows = [{"scene": "cup", "recipe": name, "cells": cells} for name in ("four", "one")]
    results = {"scenes": [{"name": "cup"}], "table": rows}
    drawn = exposure_svg(results, {("cup", "four"): 252, ("cup", "one"): 63})  # type: ignore[arg-type]
    assert drawn is not None
    root = ElementTree.fromstring(drawn)
    titles = [title.text or "" for title in root.iter("{http://www.w3.org/2000/svg}title")]
    assert len(titles) == 8
    assert any("cup, four, 252 pictures" in title for title in titles)
    words = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert words.index("one") < words.index("63") < words.index("four") < words.index("252")
