"""Training on a GPU: it learns what the CPU learns, waits for nothing of its own, and its checkpoints move about."""

from pathlib import Path
from typing import Any

import pytest
import torch

from polarguide.capture import Scene
from polarguide.raster import Backend, Rasterized, choose_backend
from polarguide.raster.cuda import has_gsplat
from polarguide.recipes import RECIPES
from polarguide.runs.folder import load_checkpoint, resolve, save_checkpoint
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available(), reason="no CUDA GPU -> on a machine with one: make gpu-check"
    ),
    pytest.mark.skipif(not has_gsplat(), reason="no gsplat -> pip install '.[cuda]'"),
]


def final_psnr(scene: Scene, recipe: Recipe, backend: Backend, steps: int = 200) -> float:
    reports: list[float] = []
    trainer = Trainer(scene, recipe, resolve(TrainSettings(steps, 3), scene, recipe), backend)
    trainer.run(lambda report: reports.append(report.psnr))
    return sum(reports[-20:]) / 20


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_every_recipe_learns_what_the_cpu_learns(tiny_scene: Scene, name: str) -> None:
    cpu, cuda = (final_psnr(tiny_scene, RECIPES[name], choose_backend(d)) for d in ("cpu", "cuda"))
    assert abs(cpu - cuda) < 1.0


def test_all_that_can_happen_happens(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    counts: list[int] = []
    trainer = Trainer(
        tiny_scene,
        busy_recipe,
        resolve(TrainSettings(60, 3), tiny_scene, busy_recipe),
        choose_backend("cuda"),
    )
    trainer.run(lambda report: counts.append(report.gaussians))
    assert len(set(counts)) > 3
    state = trainer.state.tensors()
    assert all(t.device.type == "cuda" for name, t in state.items() if name != "scalars")
    assert all(bool(torch.isfinite(t).all()) for t in state.values() if t.is_floating_point())


@pytest.mark.parametrize(("first", "second"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_checkpoint_goes_on_elsewhere(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, first: Any, second: Any
) -> None:
    settings = resolve(TrainSettings(60, 3), tiny_scene, busy_recipe)
    begun = Trainer(tiny_scene, busy_recipe, settings, choose_backend(first))
    begun.run(lambda _: None, until=30)
    save_checkpoint(tmp_path, begun.state)
    backend = choose_backend(second)
    state = load_checkpoint(tmp_path, busy_recipe, backend.device)
    Trainer(tiny_scene, busy_recipe, settings, backend, state).run(lambda _: None)
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
    trainer = Trainer(tiny_scene, RECIPES[name], settings, backend._replace(rasterize=rasterize))
    views, begin = len(tiny_scene.train_views), 1
    for stage in RECIPES[name].stages:
        trainer.state.step = begin
        for _ in range(2 * views):  # all pictures, and their priors, reach the device
            trainer.step()
        torch.cuda.set_sync_debug_mode("error")
        strict = True
        try:
            for slot in range(views):
                trainer._backpropagate(slot, stage, True)
                trainer._optimize()
        finally:
            strict = False
            torch.cuda.set_sync_debug_mode("default")
        begin += round(stage.fraction * settings.steps)
