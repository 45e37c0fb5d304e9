"""Normals and depth of the surface, in a picture whose layers stay as they are."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from torch import Tensor

from polarguide.capture import Scene
from polarguide.raster import choose_backend
from polarguide.raster.surface import surface_picture
from polarguide.recipes import recipe_named
from polarguide.runs.defaults import resolve
from polarguide.shading.gbuffer import RenderRequest, render, splatting
from polarguide.shading.model import PLAIN
from polarguide.shading.result import RenderResult
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer


@pytest.fixture(scope="module")
def trainer(tiny_scene: Scene) -> Trainer:
    recipe = recipe_named("polarguide-stokes")
    made = Trainer(
        tiny_scene, recipe, resolve(TrainSettings(steps=60), tiny_scene, recipe), choose_backend("cpu")
    )
    made.run(lambda _: None, until=30)
    return made


def seen(trainer: Trainer, **asked: bool) -> RenderResult:
    state, camera = trainer.state, trainer.scene.test_views[0].camera
    with torch.no_grad():
        return render(
            state.gaussians,
            camera,
            trainer.backend.rasterize,
            RenderRequest(**asked),
            shading=trainer.shading,
            light=state.light,
        )


def test_the_layers_and_the_polarization_stay(trainer: Trainer) -> None:
    camera = trainer.scene.test_views[0].camera
    blended, found = seen(trainer, depth=True), seen(trainer, depth=True, at_median_depth=True)
    for field in fields(RenderResult):
        one, other = (getattr(result, field.name) for result in (blended, found))
        if field.name not in ("normal", "depth", "blended_normal") and isinstance(one, Tensor):
            assert torch.equal(one, other), field.name
    assert found.blended_normal is not None
    assert torch.equal(found.blended_normal, blended.normal)
    assert found.shaded_normal is found.blended_normal
    assert blended.shaded_normal is blended.normal
    predicted = [trainer.shading.predicted_stokes(result, camera) for result in (blended, found)]
    assert torch.equal(*predicted)


def test_normals_and_depth_are_those_around_the_median(trainer: Trainer) -> None:
    found, gaussians = seen(trainer, depth=True, at_median_depth=True), trainer.state.gaussians
    camera = trainer.scene.test_views[0].camera
    assert found.normal is not None
    assert found.depth is not None
    with torch.no_grad():
        given, _ = splatting(gaussians, camera, PLAIN, sh_degree=0, normals=False, depth=False)
    expected = surface_picture(given, camera)
    assert torch.equal(found.depth, expected.depth)
    assert bool((found.normal.norm(dim=-1) <= found.alpha + 1e-5).all())
    blended = seen(trainer, depth=True)
    assert blended.depth is not None
    assert float((found.depth - blended.depth).abs().max()) > 1e-3, "they are not the same thing"


def test_what_is_not_asked_for_is_not_there(trainer: Trainer) -> None:
    assert seen(trainer, at_median_depth=True).depth is None
    state, camera = trainer.state, trainer.scene.test_views[0].camera
    plain = render(
        state.gaussians,
        camera,
        trainer.backend.rasterize,
        RenderRequest(normals=False, depth=True, at_median_depth=True),
        shading=PLAIN,
    )
    assert plain.normal is None
    assert plain.blended_normal is None
    assert plain.depth is not None
    assert not plain.depth.requires_grad
