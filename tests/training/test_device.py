"""A training step on another device: nothing of it lies on the CPU, and nothing is asked back.

The device is torch's ``meta``, which has shapes and no values: it refuses every question about a value, and a watcher
refuses what it lets pass, tensors of the CPU and copies. The rasterizer is a stand-in that only gets the shapes right.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from polarguide.capture import Scene
from polarguide.geometry.camera import Camera
from polarguide.raster import Backend, Rasterized, ScreenStatistic, Splats
from polarguide.recipes import RECIPES
from polarguide.runs.defaults import resolve
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer, first_state

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]

META = torch.device("meta")
# What brings a value to the host, or makes a shape of values.
WAITS = ("item", "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "unique")


class Watcher(TorchDispatchMode):
    """Collects operations that mix devices, copy between them, make tensors on the CPU, or wait."""

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.count += 1
        given = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        made = [t for t in tree_leaves(result) if isinstance(t, Tensor)]
        name = str(func)
        there = any(t.device == META for t in (*given, *made))
        here = [t for t in given if t.device.type == "cpu"]
        if any(word in name for word in WAITS) and any(t.device == META for t in given):
            self.faults.append(f"{name} waits")
        if there and any(t.ndim for t in here):
            self.faults.append(f"{name} takes {[list(t.shape) for t in here]} of the CPU")
        if "index" in name and any(t.dtype == torch.bool and t.device == META for t in given):
            self.faults.append(f"{name} counts a mask")
        return result


class _Splat(torch.autograd.Function):
    """Shapes and devices of a rasterizer, forward and backward."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        *tensors, camera, statistic, still = inputs
        assert all(t.device == META for t in tensors)
        ctx.save_for_backward(*tensors)
        ctx.statistic = statistic
        radii = tensors[0].new_empty(tensors[0].shape[0])
        ctx.mark_non_differentiable(radii)
        size = camera.height, camera.width
        again = tensors[4].new_empty(*size, len(still)) if still else None
        return tensors[4].new_empty(*size, tensors[4].shape[1]), tensors[4].new_empty(size), radii, again

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        assert all(g is None or g.device == META for g in grads)
        if ctx.statistic is not None:
            ctx.statistic.gradient = ctx.saved_tensors[0].new_empty(ctx.saved_tensors[0].shape[0], 2)
        return (*(torch.empty_like(t) for t in ctx.saved_tensors), None, None, None)


def stand_in(
    splats: Splats,
    camera: Camera,
    *,
    statistic: ScreenStatistic | None = None,
    still: tuple[int, ...] = (),
) -> Rasterized:
    return Rasterized(*_Splat.apply(*splats, camera, statistic, still))


@pytest.fixture(autouse=True)
def plain_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's fused Adam has no ``meta`` version; where the moments lie is the same without it."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, eps, fused: adam(groups, eps=eps, foreach=True))


def started(scene: Scene, recipe: Recipe, views: int = 1) -> Trainer:
    settings = resolve(TrainSettings(40, 0, views_per_step=views), scene, recipe)
    state = first_state(scene, recipe, settings, META)
    return Trainer(scene, recipe, settings, Backend(META, stand_in), state)


def plain_steps(trainer: Trainer) -> list[int]:
    """A step of each stage before which nothing is due."""
    steps: dict[str, int] = {}
    for step in range(trainer.settings.steps):
        position = trainer.schedule.at(step)
        if not position.actions:
            steps.setdefault(position.stage.name, step)
    return list(steps.values())


def look_at_all(trainer: Trainer, step: int) -> None:
    """A step of the stage at ``step`` on every training view, without a round of the density control."""
    for slot in range(len(trainer.scene.train_views)):
        trainer.state.step = step
        trainer._backpropagate(slot, trainer.schedule.at(step).stage, True)
        trainer._join_gradients(idle=False)
        trainer._optimize()


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_a_plain_step_stays_on_its_device_and_waits_for_nothing(tiny_scene: Scene, name: str) -> None:
    trainer = started(tiny_scene, RECIPES[name])
    stages = plain_steps(trainer)
    assert len(stages) == len(RECIPES[name].stages)
    for step in stages:
        look_at_all(trainer, step)  # pictures, priors and poses reach the device
        with Watcher() as watcher:
            look_at_all(trainer, step)
        assert watcher.count > 100
        assert watcher.faults == []


def test_several_views_a_step_stay_there_too(tiny_scene: Scene) -> None:
    trainer = started(tiny_scene, RECIPES["polarguide"], views=2)
    (step, *_) = plain_steps(trainer)
    trainer.state.step = step
    with Watcher() as watcher:
        report = trainer.step()
    assert watcher.count > 100
    assert report.measured.device == META
    assert trainer.state.statistics.gradient.shape == (2, len(trainer.state.gaussians))
    assert trainer.state.statistics.gradient.device == META


def test_what_happens_between_steps_stays_there_too(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    trainer = started(tiny_scene, busy_recipe)
    for action in ("reset_opacity", "propagate_normals", "refresh_priors"):
        trainer._act(action)
    assert all(trainer.state.gaussians[name].device == META for name in trainer.state.gaussians.names)


def test_the_watcher_sees_what_it_is_there_for() -> None:
    there = torch.empty(4, 3, device=META)
    with Watcher() as watcher:
        there[torch.tensor([0, 1])]
        there.index_select(0, torch.empty(2, dtype=torch.int64, device=META))
        there + torch.tensor(1.0)  # numbers may come along
        torch.ones(4, 3).to(META)
    assert len(watcher.faults) == 2
    for question in (
        lambda: there.sum().item(),
        lambda: there[there > 0],
        lambda: there.cpu(),
        there.nonzero,
    ):
        with pytest.raises((RuntimeError, NotImplementedError)):
            question()
