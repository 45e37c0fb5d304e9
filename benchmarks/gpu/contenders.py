"""Compare a ``polarguide`` step with a plain gsplat step: the same Gaussians, pictures, SSIM and Adam."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from polarguide.capture import Scene
from polarguide.gaussians.gaussians import CORE_SHAPES, Gaussians
from polarguide.methods import RECIPES
from polarguide.optics.color import srgb_encode
from polarguide.raster import Backend, ScreenStatistic, Splats
from polarguide.runs.folder import resolve
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.losses import Weights
from polarguide.training.photometric import photometric_loss
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings

STEPS, BEGIN = 1_000_000, 300_000  # in stage 2 of polarguide, with all harmonics


def steady(name: str) -> Recipe:
    """Return a recipe without actions between steps: no density control, resets or refreshes."""
    recipe = RECIPES[name]
    stages = tuple(replace(stage, repeats=()) for stage in recipe.stages)
    return replace(recipe, stages=stages, densification=replace(recipe.densification, every=STEPS))


def split_to(state: TrainingState, count: int, seed: int = 0) -> dict[str, Tensor]:
    """Return parameters of ``count`` Gaussians: smaller copies of those of a trained state, drawn from each."""
    parameters, generator = state.gaussians.snapshot(), torch.Generator().manual_seed(seed)
    present = len(parameters["means"])
    pick = torch.arange(count) % present
    copies = count / present
    chosen = {name: t[pick.to(t.device)] for name, t in parameters.items()}
    drawn = torch.randn(count, 3, generator=generator).to(chosen["means"])
    # Copies stay on flat surfaces: along the shortest axis they are less far away.
    chosen["means"] = chosen["means"] + 0.5 * drawn * chosen["log_scales"].exp()
    chosen["log_scales"] = chosen["log_scales"] - torch.log(torch.tensor(copies**0.5))
    return chosen


class Ours:
    """Steps of the recipe ``polarguide`` in its second stage, through the trainer."""

    def __init__(self, scene: Scene, state: TrainingState, backend: Backend) -> None:
        recipe = steady("polarguide")
        state.step = BEGIN
        settings = resolve(TrainSettings(STEPS, 0), scene, recipe)
        self.trainer, _ = gaussian_training(TrainingContext(scene, recipe, settings, backend), state)
        self.trainer.prepare()
        self.stage = self.trainer.schedule.at(BEGIN).stage
        assert self.stage.reflection
        assert self.stage.densify
        self._turn = 0

    def forward(self) -> None:
        """Render a step."""
        trainer, state = self.trainer, self.trainer.state
        render(
            state.gaussians,
            trainer.feed.view_at(state.step + self._next()).camera,
            trainer.context.backend.rasterize,
            RenderRequest(depth=True),
            shading=trainer.context.shading,
            light=state.light,
        )

    def look(self) -> None:
        """Run forward and backward with all losses."""
        state = self.trainer.state
        before = state.step
        state.step += self._next()
        self.trainer.backpropagate()
        state.step = before

    def step(self) -> None:
        """Run a complete step."""
        self.trainer.step()

    @torch.no_grad()
    def frame(self, *, layers: bool) -> None:
        """Render a picture of a trained scene: the final layer, or all layers."""
        trainer, state = self.trainer, self.trainer.state
        view = trainer.feed.view_at(state.step + self._next())
        render(
            state.gaussians,
            view.camera,
            trainer.context.backend.rasterize,
            RenderRequest(normals=layers, depth=layers),
            shading=trainer.context.shading,
            light=state.light,
        )

    def parts(self) -> dict[str, Any]:
        """Return the rasterizer, SSIM and the optimizer of a step as separate calls."""
        trainer, gaussians = self.trainer, self.trainer.state.gaussians
        view = trainer.feed.view_at(trainer.state.step)
        inputs = Splats(
            gaussians["means"],
            gaussians["quaternions"],
            gaussians["log_scales"].exp(),
            torch.sigmoid(gaussians["opacity_logits"]),
            torch.rand(len(gaussians), 8, device=gaussians["means"].device),
        )
        splats = Splats(*(t.detach().requires_grad_() for t in inputs))
        shown = trainer.feed.targets(trainer.state.step, view, Weights()).picture
        prediction = shown.clone().requires_grad_()

        def raster() -> None:
            picture = trainer.context.backend.rasterize(
                splats, view.camera, statistic=ScreenStatistic((0, 1, 2))
            )
            torch.autograd.grad((picture.features.sum() + picture.alpha.sum()), splats)

        def ssim() -> None:
            weights = self.stage.weights
            for _ in range(1 + (weights.specular > 0) + (weights.diffuse > 0)):
                torch.autograd.grad(photometric_loss(prediction, shown), prediction)

        def optimizer() -> None:
            for name in gaussians.names:
                gaussians[name].grad = torch.zeros_like(gaussians[name])
            trainer.update_parameters()

        return {"rasterizer": raster, "ssim": ssim, "optimizer": optimizer}

    def _next(self) -> int:
        self._turn = (self._turn + 1) % len(self.trainer.context.scene.train_views)
        return self._turn


class Plain:
    """Plain 3D Gaussian splatting by gsplat's own ``rasterization``, including harmonics."""

    def __init__(self, scene: Scene, parameters: dict[str, Tensor], device: torch.device) -> None:
        self._gsplat = importlib.import_module("gsplat")
        rates = RECIPES["3dgs"].rates
        self.gaussians = Gaussians({name: parameters[name] for name in CORE_SHAPES}, rates)
        self._views = []
        for view in scene.train_views:
            camera = view.camera
            shown = srgb_encode(view.photograph().clamp(0, 1)).to(device)
            poses = (t[None].to(device, torch.float32) for t in (camera.world_to_camera, camera.intrinsics))
            self._views.append((*poses, camera.width, camera.height, shown))
        self._pull = torch.zeros(len(self.gaussians), device=device)
        self._turn = 0

    def forward(self) -> tuple[Tensor, dict[str, Any], Tensor]:
        """Return a picture, gsplat's statistics of it, and the photograph."""
        self._turn = (self._turn + 1) % len(self._views)
        viewmat, intrinsics, width, height, shown = self._views[self._turn]
        gaussians = self.gaussians
        picture, _, details = self._gsplat.rasterization(
            gaussians["means"],
            gaussians["quaternions"],
            gaussians["log_scales"].exp(),
            torch.sigmoid(gaussians["opacity_logits"]),
            torch.cat((gaussians["sh_dc"][:, None], gaussians["sh_rest"]), dim=1),
            viewmat,
            intrinsics,
            width,
            height,
            sh_degree=3,
            packed=False,
        )
        return picture[0], details, shown

    def look(self) -> None:
        """Run forward and backward, and update the statistic of the density control."""
        picture, details, shown = self.forward()
        details["means2d"].retain_grad()
        photometric_loss(picture, shown).backward()
        self._pull += details["means2d"].grad[0].norm(dim=-1)

    def step(self) -> None:
        """Run a complete step."""
        self.look()
        self.gaussians.step()

    @torch.no_grad()
    def frame(self) -> None:
        """Render a picture."""
        self.forward()
