"""What a viewer shows: Gaussians and their light as they are at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.gaussians.gaussians import Gaussians
from polarguide.raster.interface import Rasterize
from polarguide.runs.opened import TrainedRun
from polarguide.shading.deferred import render
from polarguide.shading.model import Parameters, ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.trainer import Trainer


@dataclass(frozen=True, eq=False)
class Shown:
    """A scene to be rendered.

    Attributes:
        gaussians: the Gaussians. environment: parameters of the learned light; None: no reflection (yet).
        shading: of the recipe. rasterize: of the backend. sh_degree: of the base color.
        status: a line about it.
    """

    gaussians: Gaussians
    environment: Mapping[str, Tensor] | None
    shading: ShadingModel
    rasterize: Rasterize
    sh_degree: int
    status: str

    @torch.no_grad()
    def render(
        self, camera: Camera, gaussians: Parameters, environment: Mapping[str, Tensor] | None, *, depth: bool
    ) -> RenderResult:
        """All layers, on the CPU, of some of its rows in some light."""
        return render(
            gaussians,
            camera,
            self.rasterize,
            sh_degree=self.sh_degree,
            environment=environment,
            shading=self.shading,
            depth=depth,
        ).to("cpu")


def shown_run(run: TrainedRun) -> Shown:
    """A trained run."""
    gaussians = run.state.gaussians
    status = f"{run.recipe.name}, {run.state.step:,} steps; {len(gaussians):,} Gaussians"
    return Shown(gaussians, run.environment, run.shading, run.backend.rasterize, 3, status)


def shown_training(trainer: Trainer) -> Shown:
    """A training as it is between two steps; in stages without reflection it has no light."""
    state, steps = trainer.state, trainer.settings.steps
    stage = trainer.schedule.at(min(state.step, steps - 1)).stage
    light = state.environment.parameters if state.environment and stage.reflection else None
    progress = f"step {state.step:,} of {steps:,} ({stage.name})"
    status = f"{trainer.recipe.name}, {progress}; {len(state.gaussians):,} Gaussians"
    return Shown(
        state.gaussians,
        light,
        trainer.recipe.shading(trainer.settings.refractive_index),
        trainer.backend.rasterize,
        trainer.schedule.sh_degree(min(state.step, steps - 1)),
        status,
    )
