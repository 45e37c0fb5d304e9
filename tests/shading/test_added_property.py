"""A surface property of a plug-in goes from its parameter to a GLB; nothing but the plug-in knows of it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from coated_shading import CLEARCOAT, COATED
from glb_files import read_glb

import polarguide
from polarguide.core.options import ModelOptions
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.results.export.adapters import ply_fields
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import render, splatting


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, demo_scene: Path) -> OpenedRun:
    folder = tmp_path_factory.mktemp("coated") / "run"
    scene = polarguide.load_scene(demo_scene, downscale=8)
    polarguide.train(scene, folder, recipe=COATED, settings=polarguide.TrainSettings(steps=30))
    return polarguide.open_run(folder, recipe=COATED, scene=scene)


def test_it_is_learned_from_its_initial_value(run: OpenedRun) -> None:
    logits = run.model.state.gaussians["clearcoat_logits"].detach()
    assert logits.shape == (run.model.gaussians,)
    assert float(logits.std()) > 1e-3
    assert float((torch.sigmoid(logits).mean() - CLEARCOAT.initial).abs()) < 0.2


def test_it_is_blended_by_the_native_kernel(run: OpenedRun) -> None:
    gaussians = run.model.state.gaussians
    camera = run.scene.test_views[0].camera
    how = {"sh_degree": 0, "normals": True, "depth": False}
    (splats, layout), (expected, _) = (
        splatting(gaussians, camera, run.model.shading, **how, native=native) for native in (True, False)
    )
    assert type(splats.features.grad_fn).__name__ == "_SplattingBackward"
    assert "clearcoat" in layout
    torch.testing.assert_close(splats.features, expected.features, rtol=1e-4, atol=1e-5)


def test_its_layer_is_the_mean_of_the_gaussians(run: OpenedRun) -> None:
    gaussians = {name: t.detach().clone() for name, t in run.model.state.gaussians.snapshot().items()}
    gaussians["clearcoat_logits"][:] = torch.logit(torch.tensor(0.6))
    camera: Camera = run.scene.test_views[0].camera
    result = render(gaussians, camera, rasterize_cpu, shading=run.model.shading, light=run.model.light)
    shown = result.alpha > 0.5
    torch.testing.assert_close(
        result.layers["clearcoat"][shown], torch.full_like(result.alpha[shown], 0.6), rtol=1e-4, atol=1e-4
    )


def test_it_is_a_field_of_a_ply(run: OpenedRun, tmp_path: Path) -> None:
    run.export("ply", tmp_path, fields="all")
    read = read_ply(tmp_path / "polarguide.ply")["extra"]["clearcoat"].flatten()
    own = ply_fields(run.model.shading, run.model.state.gaussians)["clearcoat"].detach()
    assert len(read) <= len(own)
    assert bool(torch.isin(read, own).all())


def test_it_is_a_texture_of_a_glb(run: OpenedRun, tmp_path: Path) -> None:
    for name in ("xatlas", "embreex", "fast_simplification"):
        pytest.importorskip(name, reason=f"no {name} -> pip install '.[model]'")
    options = ModelOptions(triangles=500, texture=64, base_color="diffuse")
    run.export("glb", tmp_path, resolution=32, model=options)
    tree, _ = read_glb(tmp_path / "model.glb")
    assert "KHR_materials_clearcoat" in tree["extensionsUsed"]
    coat = tree["materials"][0]["extensions"]["KHR_materials_clearcoat"]
    assert coat["clearcoatFactor"] == 1.0
    image = tree["images"][tree["textures"][coat["clearcoatTexture"]["index"]]["source"]]
    view = tree["bufferViews"][image["bufferView"]]
    data = (tmp_path / "model.glb").read_bytes()
    begin = data.index(b"BIN\0") + 4 + view["byteOffset"]
    pixels = cv2.imdecode(np.frombuffer(data[begin : begin + view["byteLength"]], np.uint8), 1)
    assert abs(pixels.mean() / 255 - CLEARCOAT.initial) < 0.25
