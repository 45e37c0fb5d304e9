"""Scenes, recipes and metrics as objects: what is accepted, what other processes receive, and the figures."""

import base64
import json
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import torch
from comparison_records import results, run
from faults import Fault
from tiny import make_scene

import polarguide
from polarguide.core import progress
from polarguide.core.progress import NotebookReporter, notebook_reporter
from polarguide.methods import registry
from polarguide.results.evaluation import table
from polarguide.results.evaluation.evaluate import read_metrics
from polarguide.training.losses import Weights, term
from polarguide_bench.children import Definitions
from polarguide_bench.figures import read_curve, training_curves, write_figures
from polarguide_bench.objects import (
    chosen_recipes,
    packed_definitions,
    recipe_digest,
    register_definitions,
)

BASE = polarguide.recipes()["3dgs"]


def brightness(target: Any, layers: Any) -> Any:
    return SCALE * layers["final"].mean()


SCALE = 2.0
BRIGHTNESS = polarguide.Metric("brightness", "brightness", "", 3, None, measure=brightness)


@dataclass(frozen=True)
class FlatWeights(Weights):
    """Weights with a term of a user."""

    dark: float = term(rendered=("layers",))

    def own_terms(self) -> Any:
        return (lambda step, weights: weights.dark * step.result.final.mean(),)


def dark(weight: float = 0.1) -> polarguide.Recipe:
    stages = [replace(s, weights=FlatWeights(**vars(s.weights), dark=weight)) for s in BASE.stages]
    return replace(BASE, name="dark", stages=tuple(stages))


@pytest.fixture(autouse=True)
def forget() -> Iterator[Callable[[], None]]:
    """Forget what a test has registered, at its end and when it calls the function."""
    lists = (table.PLUGGED, table.METRICS, table.VIEW_METRICS, table.COLUMNS)
    before = [[*metrics] for metrics in lists]

    def forget_all() -> None:
        registry.REGISTERED.clear()
        table.REGISTERED.clear()
        for metrics, old in zip(lists, before, strict=True):
            metrics[:] = old

    yield forget_all
    forget_all()


def test_recipes_are_listed_with_their_descriptions() -> None:
    recipes = polarguide.recipes()
    assert recipes["3dgs"].name == "3dgs"
    assert re.search(r"^3dgs  +\S.+$", repr(recipes), re.MULTILINE)
    chosen_recipes([dark()])
    assert polarguide.recipes()["dark"] == dark()


def test_a_recipe_with_a_new_name_is_known_by_its_name() -> None:
    first, second = chosen_recipes(["3dgs", dark(0.2)])
    assert (first, second) == (BASE, dark(0.2))
    assert recipe_digest(first) == ""
    digest = recipe_digest(second)
    (again,) = chosen_recipes([dark(0.3)])
    assert again == registry.recipe_named("dark") == dark(0.3)
    assert len(digest) == 16
    taken = replace(BASE, ssim_weight=0.5)
    Fault("recipe 3dgs", "no other recipe", "other values").raised_by(chosen_recipes, [taken])
    Fault("recipes", "more than once", "dark twice").raised_by(chosen_recipes, ["dark", dark(0.3)])
    Fault("recipes", "names of recipes", "3").raised_by(chosen_recipes, [3])
    broken = replace(BASE, name="mine", ssim_weight="much")
    Fault("recipe mine (ssim_weight)").raised_by(chosen_recipes, [broken])


@pytest.mark.parametrize("name", ["gnerp", "gnerp:mine"])
def test_a_reserved_name_is_refused_and_not_registered(name: str) -> None:
    Fault(f"recipe {name}", "does not begin with gnerp", "baseline").raised_by(
        chosen_recipes, [replace(BASE, name=name)]
    )
    assert name not in registry.REGISTERED
    assert "3dgs" in polarguide.recipes()


@pytest.mark.parametrize("argument", ["scenes", "recipes", "metrics"])
@pytest.mark.parametrize("value", ["text", BASE, BRIGHTNESS, make_scene(), Path("scene"), None])
def test_a_single_object_instead_of_a_list_is_refused(tmp_path: Path, argument: str, value: Any) -> None:
    out = tmp_path / "out"
    arguments = {"scenes": [tmp_path], "recipes": ["3dgs"], "metrics": []} | {argument: value}
    Fault(argument, f"{argument}=[...]", f"a single {type(value).__name__}").raised_by(
        polarguide.compare, out=out, **arguments
    )
    for name in ("only", "reference"):
        Fault(name, "a list", "a single str").raised_by(
            polarguide.ablate, [tmp_path], "polarguide", out, **{name: "without-normals"}
        )
    assert not out.exists()


@pytest.mark.parametrize(
    ("metric", "fault"),
    [
        (brightness, Fault("metrics", "metrics", "function brightness")),
        (replace(BRIGHTNESS, key="psnr"), Fault("metrics", "no other metric", "psnr")),
        (replace(BRIGHTNESS, digits=-1), Fault("metrics, brightness (digits)", "0 to 10", "-1")),
        (replace(BRIGHTNESS, of="run"), Fault("metrics", "a metric of views")),
    ],
)
def test_a_wrong_metric_is_refused(tmp_path: Path, metric: Any, fault: Fault) -> None:
    out = tmp_path / "out"
    fault.raised_by(polarguide.compare, [tmp_path], ["3dgs"], out, metrics=[metric])
    assert not out.exists()


def test_a_metric_that_fails_names_itself() -> None:
    table.register_metric(replace(BRIGHTNESS, measure=lambda target, layers: layers["sky"]))
    table.register_metric(BRIGHTNESS)
    (metric,) = (metric for metric in table.VIEW_METRICS if metric.key == "brightness")
    target: Any = types.SimpleNamespace(photograph=torch.zeros(2, 2, 3))
    assert metric.measure is not None
    assert metric.measure(target, {"final": torch.ones(2, 2, 3)}) == 2.0
    Fault("metrics, brightness", "a real tensor", "KeyError: 'final'").raised_by(metric.measure, target, {})


def test_another_process_receives_definitions_and_their_digests(forget: Callable[[], None]) -> None:
    assert packed_definitions() is None
    chosen_recipes([dark()])
    table.register_metric(BRIGHTNESS)
    digests = table.registered_digests()
    packed = packed_definitions()
    assert packed is not None
    forget()
    register_definitions(packed)
    assert registry.recipe_named("dark").data() == dark().data()
    assert table.registered_digests() == digests
    assert "brightness" in [metric.key for metric in table.COLUMNS]
    Fault("recipes, metrics", "import").raised_by(register_definitions, Definitions((), b"x"))
    table.register_metric(replace(BRIGHTNESS, measure=lambda target, layers: None))
    assert table.registered_digests() != digests


def test_a_scene_that_processes_cannot_read_is_refused(demo_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    Fault("scenes", "scenes in folders", "in memory").raised_by(
        polarguide.compare, [replace(make_scene(), root=Path("(arrays)"))], ["3dgs"], out
    )
    Fault("scenes", "paths", "a int").raised_by(polarguide.compare, [3], ["3dgs"], out)
    scene = polarguide.load_scene(demo_scene, downscale=8)
    other = polarguide.CompareOptions(downscale=4)
    Fault("scenes", "downscale 4", "downscale 8").raised_by(
        polarguide.compare, [scene], ["3dgs"], out, options=other
    )
    full = polarguide.load_scene(demo_scene, downscale=1)
    for scenes in ([full, scene], [scene, full], [demo_scene, full, scene]):
        first, second = [item.downscale for item in scenes if isinstance(item, polarguide.Scene)]
        Fault("scenes", f"downscale {first}", f"downscale {second}").raised_by(
            polarguide.compare, scenes, ["3dgs"], out
        )
    fewer = replace(scene, views=scene.views[1:])
    Fault("scenes", "as its folder contains it").raised_by(polarguide.compare, [fewer], ["3dgs"], out)
    assert not out.exists()


@pytest.mark.slow
def test_objects_are_compared_without_a_package(demo_scene: Path, tmp_path: Path) -> None:
    scene = polarguide.load_scene(demo_scene, downscale=8)
    options = polarguide.CompareOptions(jobs=1, device="cpu", report_views=0)
    settings = polarguide.TrainSettings(8)
    found = polarguide.compare(
        [scene], [dark(), "3dgs"], tmp_path, metrics=[BRIGHTNESS], settings=settings, options=options
    )
    assert found.runs["state"].tolist() == ["done", "done"]
    assert found.runs["brightness"].notna().all()
    assert found.runs["brightness"].nunique() == 2
    assert "brightness" in (tmp_path / "results.md").read_text()
    assert (tmp_path / "results.pdf").read_bytes().startswith(b"%PDF")
    first = read_metrics(tmp_path / found.runs["folder"][0])
    assert first["provenance"]["metrics"] == table.registered_digests()


def figure_texts(out: Path) -> str:
    return (out / "results.svg").read_text()


def test_figures_have_a_point_for_each_seed(tmp_path: Path) -> None:
    runs = [
        run(scene, recipe, seed, psnr=30.0 + seed + len(recipe), normal_mae_deg=5.0 - seed)
        for scene in ("cup", "car")
        for recipe in ("3dgs", "polarguide-stokes")
        for seed in (0, 1, 2)
    ]
    write_figures(tmp_path, results(runs))
    svg = figure_texts(tmp_path)
    assert svg.count("<use ") >= 2 * len(runs)
    for text in ("3dgs", "polarguide-stokes", "cup", "car", "PSNR (dB)", "normal error (deg)"):
        assert f">{text}" in svg
    assert "SSIM" not in svg
    assert (tmp_path / "results.pdf").read_bytes().startswith(b"%PDF")
    before = (tmp_path / "results.svg").read_bytes()
    write_figures(tmp_path, results(runs))
    assert (tmp_path / "results.svg").read_bytes() == before
    write_figures(tmp_path, results([run("cup", "3dgs", 0)]))
    assert not (tmp_path / "results.svg").exists()


def test_a_notebook_displays_progress(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[str] = []
    shell = types.SimpleNamespace(kernel=None)
    handle = types.SimpleNamespace(update=shown.append)
    display = types.SimpleNamespace(
        display=lambda page, display_id: shown.append(page) or handle, HTML=lambda text: text
    )
    ipython = types.SimpleNamespace(get_ipython=lambda: shell, display=display)
    assert notebook_reporter() is progress.SILENT
    monkeypatch.setitem(progress.sys.modules, "IPython", ipython)
    assert notebook_reporter() is progress.SILENT  # a terminal
    shell.kernel = object()
    reporter = notebook_reporter()
    assert isinstance(reporter, NotebookReporter)
    with reporter.track("runs <b>", 4) as advance:
        advance(1, note="20 dB")
        advance(2)  # too early for another update
    assert shown == [
        "runs &lt;b&gt;",
        "<progress value=1 max=4></progress> runs &lt;b&gt;: 1 of 4  20 dB",
        "",
    ]
    reporter.say("done")
    reporter.warn("dark")
    assert capsys.readouterr().out == "done\nwarning: dark\n"


def test_a_log_becomes_a_curve(tmp_path: Path) -> None:
    rows: list[dict[str, float]] = [
        {"step": 10 * i + 9, "seconds": i / 2, "psnr": 20.0 + i} for i in range(1000)
    ]
    rows[500]["held_out"] = 25.5
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 3')
    curve = read_curve(tmp_path)
    assert (curve["step"].min(), curve["step"].max()) == (10, 9970)
    assert len(curve) < 300
    inner = curve[25:-25]
    np.testing.assert_allclose(inner["psnr"], 20 + (inner["step"] - 10) / 10)  # a line stays one
    assert curve["held_out"].dropna().tolist() == [25.5]


def test_curves_are_an_svg_file_with_any_name() -> None:
    curve = pd.DataFrame(
        {"step": [1, 2], "seconds": [0.1, 0.2], "psnr": [20.0, 21.0], "held_out": [np.nan, 20.5]}
    )
    head, data = training_curves({"a<b $x$ \\frac": curve, "empty": curve[:0]}).split(",")
    assert head == "data:image/svg+xml;base64"
    texts = {element.text for element in ElementTree.fromstring(base64.b64decode(data)).iter()}
    assert {"a<b $x$ \\frac", "PSNR (dB)", "steps", "seconds"} <= texts
