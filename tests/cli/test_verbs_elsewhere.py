"""Verbs on a device that is not the CPU, with values; and verbs on a field in place of Gaussians."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from other_device import BACKEND, OtherDevice, unfused_adam

from polarguide.api.runs import Run, open_run
from polarguide.capture import load_scene
from polarguide.capture.presentation import Crop, Presentation
from polarguide.cli.app import run
from polarguide.cli.runs import render_run
from polarguide.core.options import ComputeOptions
from polarguide.geometry.coverage import HAZE_DEPTH
from polarguide.geometry.scene_frame import scene_frame
from polarguide.inspection.evidence import short_run, trained_surface
from polarguide.results.evaluation.perceptual import load_package
from polarguide.results.evaluation.scores import ErrorsByObject, score_view
from polarguide.results.evaluation.target import SceneFacts, ViewTarget
from polarguide.runs import opened as opening
from polarguide.viewer import run_scenery
from polarguide.viewer.scenery import Appearance, Painter
from polarguide_bench.results import read_results
from polarguide_bench.verbs import chosen_steps


@pytest.fixture
def elsewhere(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder, which is opened on the other device unless the CPU is asked for."""
    choose = opening.choose_backend
    monkeypatch.setattr(
        opening, "choose_backend", lambda name, **more: choose(name, **more) if name == "cpu" else BACKEND
    )
    return Path(shutil.copytree(trained, tmp_path / "run"))


def test_scores_are_made_there_and_read_once_a_view(elsewhere: Path) -> None:
    with OtherDevice() as device:
        opened = open_run(elsewhere)
        record = opened.evaluate()
        view, facts = opened.scene.test_views[0], SceneFacts.of(opened.scene)
        result = opened.model.render(view.camera, depth=True, surface=True)
        stokes = opened.model.stokes(result, view.camera)
        cpu, target = torch.device("cpu"), ViewTarget.of_view(view, facts, BACKEND.device)
        in_front = opened.model.alpha_in_front(view.camera, HAZE_DEPTH * target.depth)
        before = device.waits
        there = score_view(
            target, result, stokes=stokes, in_front=in_front, by_object=ErrorsByObject(facts.objects)
        )
        # FLIP is computed on arrays: it reads two pictures and a mask.
        assert device.waits - before == (1 if load_package()[0] is None else 4)
        given = {"stokes": stokes.to(cpu), "in_front": in_front.to(cpu)}
        here = score_view(ViewTarget.of_view(view, facts, cpu), result.to("cpu"), **given)
        with pytest.raises(RuntimeError, match="mixes devices"):
            score_view(ViewTarget.of_view(view, facts, cpu), result)
    without_coverage = {key: None for key in there if "seen" in key or key == "haze_free"}
    assert there == here == {**record["views"][view.name], **without_coverage}
    by_cpu = open_run(elsewhere, device="cpu").evaluate()
    assert record["psnr"] == pytest.approx(by_cpu["psnr"], abs=0.01)
    assert record["specular_psnr"] == pytest.approx(by_cpu["specular_psnr"], abs=0.01)


def test_pictures_by_other_light_and_along_a_path(elsewhere: Path, tmp_path: Path) -> None:
    light = tmp_path / "light.hdr"
    cv2.imwrite(str(light), np.full((16, 32, 3), 0.4, np.float32))
    layers = "final,reflection,specular,normal,depth,strength"

    def shown(device: str, out: Path) -> np.ndarray:
        render_run(
            elsewhere,
            layers=layers,
            environment=light,
            rotate_environment=30,
            out=out,
            compute=ComputeOptions(device=device),
        )
        return cv2.imread(str(out / "contact_sheet.png")).astype(int)

    with OtherDevice():
        there = shown("auto", tmp_path / "there")
        render_run(
            elsewhere, layers="final,depth", rotate_environment=30, path="orbit", frames=2, out=tmp_path
        )
    assert len(list(tmp_path.glob("path_*.png"))) == 2
    # Depth's colors jump where nothing is seen, so a few pixels may differ by much.
    assert float((np.abs(there - shown("cpu", tmp_path / "here")) > 2).mean()) < 0.01


def test_the_inspection_trains_there_and_compares_here(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polarguide.gaussians.gaussians.adam", unfused_adam)
    scene = load_scene(demo_scene, downscale=8)
    with OtherDevice():
        state = short_run(scene, steps=2, backend=BACKEND, on_step=lambda _: None)
        surface = trained_surface(state, scene.views[0], BACKEND)
    assert state.step == 2
    assert {t.device.type for t in (surface.normal, surface.depth, surface.known)} == {"cpu"}


def test_the_viewer_draws_what_lies_there(elsewhere: Path) -> None:
    crop = Crop((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    chosen = [
        Appearance(layer, strength=0.5, turn=30.0, presentation=Presentation(exposure=0.5, crop=crop))
        for layer in ("final", "specular", "normal", "depth", "error")
    ]

    def drawn(opened: Run) -> list[np.ndarray]:
        view = opened.scene.test_views[0]
        painter = Painter(scene_frame(list(opened.cameras.values())))
        pictures = [painter.paint(run_scenery(opened), view.camera, look, view) for look in chosen]
        return [picture.astype(float) for picture in pictures if picture is not None]

    with OtherDevice():
        there = drawn(open_run(elsewhere))
    here = drawn(open_run(elsewhere, device="cpu"))
    assert len(there) == len(here) == len(chosen)
    for a, b in zip(there, here, strict=True):
        assert np.abs(a - b).mean() < 1


SMALL = ["--downscale", "8", "--threads", "1"]


def test_steps_of_recipes() -> None:
    assert chosen_steps(("5000",)) == (5000, {})
    assert chosen_steps(("5000", "gnerp=10000")) == (5000, {"gnerp": 10000})
    assert chosen_steps(("gnerp:circular=7",)) == (None, {"gnerp:circular": 7})


@pytest.mark.parametrize("words", [("5000", "3000"), ("gnerp=",), ("gnerp=1", "gnerp=2"), ("many",), ("-5",)])
def test_steps_that_cannot_be_read(words: tuple[str, ...]) -> None:
    Fault("--steps").raised_by(chosen_steps, words)


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
    for words in (["render", folder, "--out", str(tmp_path / "r")], ["export", folder, "--format", "mesh"]):
        assert run(words) == 2
        refused = " ".join(capsys.readouterr().err.split())
        assert "expected a recipe of Gaussians, found gnerp, a signed-distance field" in refused
        assert "polarguide compare SCENE --recipes gnerp" in refused
    for refused in (["export", folder, "--format", "ply"], ["share", folder]):
        capsys.readouterr()
        assert run(refused) == 2
        error = capsys.readouterr().err
        assert "signed-distance field" in error
        assert len(error.splitlines()) == 1
