"""Training on a GPU: it learns what the CPU learns, waits for nothing of its own, and its checkpoints move about."""

from pathlib import Path
from typing import Any

import pytest
import torch
from trainings import make_trainer, run

from polarguide.capture import Scene
from polarguide.methods import RECIPES
from polarguide.raster import Backend, Rasterized, choose_backend
from polarguide.raster.cuda import has_gsplat
from polarguide.runs.folder import load_checkpoint, resolve, save_checkpoint
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available(), reason="no CUDA GPU -> on a machine with one: make gpu-check"
    ),
    pytest.mark.skipif(not has_gsplat(), reason="no gsplat -> pip install '.[cuda]'"),
]


def final_psnr(scene: Scene, recipe: Recipe, backend: Backend, steps: int = 200) -> float:
    trainer = make_trainer(scene, recipe, steps, backend=backend)
    reports = [float(report.measured[1]) for report in run(trainer)]
    return sum(reports[-20:]) / 20


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_every_recipe_learns_what_the_cpu_learns(tiny_scene: Scene, name: str) -> None:
    cpu, cuda = (final_psnr(tiny_scene, RECIPES[name], choose_backend(d)) for d in ("cpu", "cuda"))
    assert abs(cpu - cuda) < 1.0


def test_all_that_can_happen_happens(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    trainer = make_trainer(tiny_scene, busy_recipe, 60, backend=choose_backend("cuda"))
    counts = [report.gaussians for report in run(trainer)]
    assert len(set(counts)) > 3
    state = trainer.state.tensors()
    assert all(t.device.type == "cuda" for name, t in state.items() if name != "scalars")
    assert all(bool(torch.isfinite(t).all()) for t in state.values() if t.is_floating_point())


@pytest.mark.parametrize(("first", "second"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_checkpoint_goes_on_elsewhere(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, first: Any, second: Any
) -> None:
    begun = make_trainer(tiny_scene, busy_recipe, 60, backend=choose_backend(first))
    begun.run(30)
    save_checkpoint(tmp_path, begun.state)
    backend = choose_backend(second)
    state = load_checkpoint(tmp_path, busy_recipe, backend.device)
    make_trainer(tiny_scene, busy_recipe, 60, state, backend=backend).run()
    assert state.step == 60


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_a_plain_step_waits_for_nothing_of_its_own(tiny_scene: Scene, name: str) -> None:
    """gsplat waits once a picture, for the number of intersections; we do not."""
    backend = choose_backend("cuda")
    strict = False

    def rasterize(*inputs: Any, **named: Any) -> Rasterized:
        torch.cuda.set_sync_debug_mode("default")
        try:
            return backend.rasterize(*inputs, **named)
        finally:
            torch.cuda.set_sync_debug_mode("error" if strict else "default")

    settings = resolve(TrainSettings(10_000, 0), tiny_scene, RECIPES[name])
    watched = backend._replace(rasterize=rasterize)
    trainer = make_trainer(tiny_scene, RECIPES[name], 10_000, backend=watched, seed=0)
    views, begin = len(tiny_scene.train_views), 1
    for stage in RECIPES[name].stages:
        trainer.state.step = begin
        for _ in range(2 * views):  # all pictures, and their priors, reach the device
            trainer.step()
        torch.cuda.set_sync_debug_mode("error")
        strict = True
        try:
            for _ in range(views):
                trainer.backpropagate()
                trainer.update_parameters()
                trainer.state.step += 1
        finally:
            strict = False
            torch.cuda.set_sync_debug_mode("default")
        begin += round(stage.fraction * settings.steps)
