"""Verbs on a device that is not the CPU, with values: scores, pictures, other light, and the inspection's training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from other_device import BACKEND, OtherDevice

from polarguide.api import Run, open_run
from polarguide.capture import load_scene
from polarguide.cli.render import render
from polarguide.evaluation.facts import SceneFacts
from polarguide.evaluation.flip import load_package
from polarguide.evaluation.maps import ErrorsByObject
from polarguide.evaluation.measures import HAZE_DEPTH
from polarguide.evaluation.scores import score_view
from polarguide.evaluation.target import ViewTarget
from polarguide.inspection.short_run import short_run, surface_of
from polarguide.options import ComputeOptions
from polarguide.presentation import Crop
from polarguide.scene_frame import scene_frame
from polarguide.viewer import shown_run
from polarguide.viewer.appearance import Appearance, Painter


@pytest.fixture
def run(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder, which is opened on the other device unless the CPU is asked for."""
    from polarguide.runs import opened as opening

    choose = opening.choose_backend
    monkeypatch.setattr(
        opening, "choose_backend", lambda name, **more: choose(name, **more) if name == "cpu" else BACKEND
    )
    return Path(shutil.copytree(trained, tmp_path / "run"))


def test_scores_are_made_there_and_read_once_a_view(run: Path) -> None:
    with OtherDevice() as device:
        opened = open_run(run)
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
    assert there == here == record["views"][view.name]
    by_cpu = open_run(run, device="cpu").evaluate()
    assert record["psnr"] == pytest.approx(by_cpu["psnr"], abs=0.01)
    assert record["specular_psnr"] == pytest.approx(by_cpu["specular_psnr"], abs=0.01)


def test_pictures_by_other_light_and_along_a_path(run: Path, tmp_path: Path) -> None:
    light = tmp_path / "light.hdr"
    cv2.imwrite(str(light), np.full((16, 32, 3), 0.4, np.float32))
    layers = "final,reflection,specular,normal,depth,strength"

    def shown(device: str, out: Path) -> np.ndarray:
        render(
            run,
            layers=layers,
            environment=light,
            rotate_environment=30,
            out=out,
            compute=ComputeOptions(device=device),
        )
        return cv2.imread(str(out / "contact_sheet.png")).astype(int)

    with OtherDevice():
        there = shown("auto", tmp_path / "there")
        render(run, layers="final,depth", rotate_environment=30, path="orbit", frames=2, out=tmp_path)
    assert len(list(tmp_path.glob("path_*.png"))) == 2
    # Depth's colors jump where nothing is seen, so a few pixels may differ by much.
    assert float((np.abs(there - shown("cpu", tmp_path / "here")) > 2).mean()) < 0.01


def test_the_inspection_trains_there_and_compares_here(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, eps, fused: adam(groups, eps=eps, foreach=True))
    scene = load_scene(demo_scene, downscale=8)

    def stop(report: object) -> None:
        raise KeyboardInterrupt

    with OtherDevice():
        with pytest.raises(KeyboardInterrupt):
            short_run(scene, tmp_path, steps=2, backend=BACKEND, on_step=stop)
        state = short_run(scene, tmp_path, steps=2, backend=BACKEND, on_step=lambda _: None)
        surface = surface_of(state, scene.views[0], BACKEND)
    assert json.loads((tmp_path / "short_run.json").read_text())["steps"] == 2
    assert state.step == 2
    assert {t.device.type for t in (surface.normal, surface.depth, surface.known)} == {"cpu"}


def test_the_viewer_draws_what_lies_there(run: Path) -> None:
    crop = Crop((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    chosen = [
        Appearance(layer, exposure=0.5, strength=0.5, turn=30.0, crop=crop)
        for layer in ("final", "specular", "normal", "depth", "error")
    ]

    def drawn(opened: Run) -> list[np.ndarray]:
        view = opened.scene.test_views[0]
        painter = Painter(scene_frame(list(opened.cameras.values())))
        pictures = [painter.paint(shown_run(opened), view.camera, look, view) for look in chosen]
        return [picture.astype(float) for picture in pictures if picture is not None]

    with OtherDevice():
        there = drawn(open_run(run))
    here = drawn(open_run(run, device="cpu"))
    assert len(there) == len(here) == len(chosen)
    for a, b in zip(there, here, strict=True):
        assert np.abs(a - b).mean() < 1
