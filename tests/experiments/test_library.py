"""Comparisons and ablations from Python: they print nothing, return their record, and keep a failure in it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from heard import Heard

import polarguide
from polarguide.core.errors import PolarguideError
from polarguide.experiments.options import CompareOptions
from polarguide.experiments.plan import Comparison, plan_runs, scene_entries
from polarguide.experiments.record import read_results
from polarguide.recipes import recipe_named
from polarguide.training.settings import TrainSettings

SETTINGS = TrainSettings(steps=20)
OPTIONS = CompareOptions(downscale=8, jobs=1, report_views=1)


@pytest.mark.slow
def test_a_comparison_and_an_ablation_share_runs(
    demo_scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    messages = Heard()
    results = polarguide.compare(
        [demo_scene],
        [recipe_named("3dgs-dr")],
        tmp_path,
        settings=SETTINGS,
        options=OPTIONS,
        reporter=messages,
    )
    index = "demo: refractive index 1.5, as scene.json says"
    assert messages.said == [index, "runs: 1, of them finished before: 0", "done  demo, 3dgs-dr, seed 0"]
    assert read_results(tmp_path / "results.json") == results.record
    assert results.runs["state"].tolist() == ["done"]
    assert results.scores["psnr"].tolist() == results.runs["psnr"].tolist()
    assert (tmp_path / "report.html").exists()

    # The run of an ablation cannot begin: its folder holds something else.
    only = "3dgs-dr:consistent"
    question = Comparison((demo_scene,), (recipe_named(only),), SETTINGS, OPTIONS, tmp_path)
    (planned,) = plan_runs(question, scene_entries(question))
    planned.folder.mkdir(parents=True)
    (planned.folder / "run.json").write_text("[]")
    results = polarguide.ablate(
        [demo_scene], "3dgs-dr", tmp_path, only=["consistent"], settings=SETTINGS, options=OPTIONS
    )
    runs = results.runs.set_index("recipe")
    assert runs["state"].to_dict() == {"3dgs-dr": "done", only: "failed"}
    assert "run.json" in runs.loc[only, "error"]
    assert results.record.settings.against == "3dgs-dr"
    assert capfd.readouterr() == ("", "")


def test_a_recipe_that_other_processes_do_not_know_is_refused(demo_scene: Path, tmp_path: Path) -> None:
    changed = dataclasses.replace(recipe_named("3dgs"), ssim_weight=0.3)
    with pytest.raises(PolarguideError, match="expected the registered recipe 3dgs, found one of this name"):
        polarguide.compare([demo_scene], [changed], tmp_path / "out")
    with pytest.raises(PolarguideError, match="against: expected one of 3dgs, found 3dgs-dr"):
        polarguide.compare(
            [demo_scene], ["3dgs"], tmp_path / "out", options=CompareOptions(against="3dgs-dr")
        )
    with pytest.raises(PolarguideError, match="recipe: expected one of"):
        polarguide.compare([demo_scene], ["magic"], tmp_path / "out")
    with pytest.raises(PolarguideError, match="compare: expected a scene, found none"):
        polarguide.compare([], ["3dgs"], tmp_path / "out")
    with pytest.raises(PolarguideError, match="compare: expected a recipe, found none"):
        polarguide.compare([demo_scene], [], tmp_path / "out")
    assert not (tmp_path / "out").exists()
