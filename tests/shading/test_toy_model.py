"""The proof that a shading model is a plug: one from a plug-in goes all the way, from its name to a shared page."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault
from plugins import install
from torch import Tensor
from trainings import context_of

from polarguide.capture import Scene
from polarguide.capture.presentation import Crop, Presentation
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.scene_frame import scene_frame
from polarguide.methods import recipe_named
from polarguide.results.evaluation.scores import score_view
from polarguide.results.evaluation.target import ViewTarget
from polarguide.results.export.adapters import ply_fields
from polarguide.results.export.web_page import BAKED, share_page
from polarguide.results.rendering.relight import needs_radiance
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.runs.model import write_run_ply
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.result import LAYERS, RenderResult
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.callbacks import reset_opacity
from polarguide.training.context import TrainingState, first_state
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.viewer import training_scenery
from polarguide.viewer.scenery import Appearance, Painter
from polarguide_bench.recipes import ablations_of

SETTINGS = TrainSettings(steps=150, seed=2, refractive_index=1.4)
STOP = 70  # after rounds of the density control, and before others


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recipe:
    install(monkeypatch, tmp_path / "site", toy="toy_shading:recipes")
    return recipe_named("toy")


@pytest.fixture
def trained(tiny_scene: Scene, toy: Recipe) -> TrainingLoop:
    return train(tiny_scene, toy)


def train(
    scene: Scene, recipe: Recipe, until: int | None = None, state: TrainingState | None = None
) -> TrainingLoop:
    trainer = gaussian_training(context_of(scene, recipe, SETTINGS), state)[0]
    trainer.run(until)
    return trainer


def bits(tensors: dict[str, Tensor]) -> dict[str, bytes]:
    return {name: values.numpy().tobytes() for name, values in tensors.items()}


def picture(trainer: TrainingLoop, **layers: bool) -> RenderResult:
    view, state = trainer.context.scene.train_views[0], trainer.state
    rasterize = trainer.context.backend.rasterize
    with torch.no_grad():
        return render(
            state.gaussians,
            view.camera,
            rasterize,
            RenderRequest(**layers),
            shading=trainer.current.shading,
            light=state.light,
        )


def test_it_trains_and_resumes_to_the_same_bits(trained: TrainingLoop, toy: Recipe, tmp_path: Path) -> None:
    first = first_state(context_of(trained.context.scene, toy, SETTINGS))
    for name in ("gloss_logits", "tint"):
        assert trained.state.gaussians[name].detach().std() > 0, "not trained"
        assert trained.state.gaussians[name].shape == (len(trained.state.gaussians), *toy.shapes[name])
    assert (trained.state.light["sky"] - first.light["sky"]).abs().min() > 1e-3
    assert len(trained.state.gaussians) != len(first.gaussians), "the density control did nothing"
    save_checkpoint(tmp_path, train(trained.context.scene, toy, until=STOP).state)
    resumed = train(trained.context.scene, toy, state=load_checkpoint(tmp_path, toy))
    assert bits(resumed.state.tensors()) == bits(trained.state.tensors())


def test_a_run_records_its_values_and_no_place_of_code(toy: Recipe) -> None:
    data = toy.data()
    assert data["shading"] == {"model": "SkyShading", "first_gloss": 0.2, "sky_rate": 0.02}
    assert "toy_shading" not in json.dumps(data)
    assert recipe_named("toy:dull").data() != data
    assert ablations_of("toy") == (recipe_named("toy:dull"),)


def test_it_renders_and_is_evaluated(trained: TrainingLoop) -> None:
    result, view = picture(trained, depth=True), trained.context.scene.train_views[0]
    assert {name for name in LAYERS if name in result.layers} == set(trained.current.shading.layers)
    assert trained.current.shading.refractive_index == SETTINGS.refractive_index
    target = ViewTarget.of(view.photograph(), view.invalid, view.ground_truth, torch.device("cpu"))
    before = gaussian_training(trained.context)[0]
    first, last = (score_view(target, picture(trainer))["psnr"] for trainer in (before, trained))
    assert last > first + 1  # type: ignore[operator]


def test_it_is_exported(trained: TrainingLoop, tmp_path: Path) -> None:
    shading = trained.current.shading
    own_fields = ply_fields(shading, trained.state.gaussians)
    write_run_ply(tmp_path / "run.ply", trained.state, shading, own_fields=own_fields)
    read = read_ply(tmp_path / "run.ply")
    assert set(read["extra"]) == {"linear_dc", "linear_rest"}
    # Display colors, reflections included: brighter than the base color alone.
    assert float((read["sh_dc"] - read["extra"]["linear_dc"]).mean()) > 0
    Fault("--format environment", "radiance").raised_by(
        needs_radiance, trained.current.shading, what="--format environment"
    )


def test_it_is_shared_with_baked_colors_and_a_note(trained: TrainingLoop) -> None:
    cameras = {view.name: view.camera for view in trained.context.scene.views}
    page = share_page(
        trained.state.gaussians,
        trained.state.light,
        trained.current.shading,
        cameras,
        first="v0",
        title="toy",
    )
    assert BAKED in page
    scene = json.loads(re.findall(r'id="scene">(.*?)</script>', page)[0])
    assert (scene["kind"], scene["layers"]) == ("plain", ["final", "normal"])


def test_it_is_viewed(trained: TrainingLoop) -> None:
    cameras = [view.camera for view in trained.context.scene.views]
    running = gaussian_training(trained.context, trained.state)[0]
    painter, shown, camera = Painter(scene_frame(cameras)), training_scenery(running), cameras[0]
    pictures = {layer: painter.paint(shown, camera, Appearance(layer=layer)) for layer in LAYERS}
    assert {layer for layer, found in pictures.items() if found is not None} == set(
        trained.current.shading.layers
    )
    presentation = Presentation(crop=Crop((-9, -9, -9), (9, 9, 9)))
    stronger = Appearance(strength=2.0, turn=30.0, presentation=presentation)
    plain = Appearance(presentation=presentation)
    found, weaker = (painter.paint(shown, camera, appearance) for appearance in (stronger, plain))
    assert found.mean() > weaker.mean() + 1


def test_a_reset_of_the_opacities_keeps_the_models_minimum(trained: TrainingLoop) -> None:
    gaussians = trained.state.gaussians
    gaussians.overwrite("gloss_logits", torch.linspace(-9, 2, len(gaussians)))
    tint = gaussians["tint"].detach().clone()
    reset_opacity(trained.state, trained.current.shading, 0.01)
    gloss = gaussians["gloss_logits"].detach()
    assert (float(gloss.min()), float(gloss.max())) == (-5.0, 2.0)
    assert torch.equal(gaussians["tint"], tint)


def test_normal_propagation_needs_a_strength(trained: TrainingLoop, toy: Recipe) -> None:
    stages = tuple(replace(stage, on_enter=("propagate_normals",)) for stage in toy.stages)
    Fault(expected="reflection strength").raised_by(train, trained.context.scene, replace(toy, stages=stages))


def test_a_checkpoint_of_another_model_is_refused(trained: TrainingLoop, tmp_path: Path) -> None:
    save_checkpoint(tmp_path, trained.state)
    for name in ("polarguide", "3dgs-dr"):
        Fault(found="no gaussians.strength_logits").raised_by(load_checkpoint, tmp_path, recipe_named(name))
    with torch.no_grad():
        trained.state.gaussians["tint"][3] = np.nan
    save_checkpoint(tmp_path, trained.state)
    Fault(found="gaussians.tint").raised_by(load_checkpoint, tmp_path, trained.context.recipe)
