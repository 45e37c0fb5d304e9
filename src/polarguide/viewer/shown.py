"""What a viewer shows: Gaussians and their light as they are at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.gaussians.rows import GaussianRows
from polarguide.raster.interface import Rasterise
from polarguide.shading.model import Rows, ShadingModel
from polarguide.shading.render import render
from polarguide.shading.result import RenderResult
from polarguide.trained import TrainedRun
from polarguide.training.trainer import Trainer


@dataclass(frozen=True, eq=False)
class Shown:
    """A scene to be rendered.

    Attributes:
        rows: the Gaussians. environment: parameters of the learned light; None: no reflection (yet).
        shading: of the recipe. rasterise: of the backend. sh_degree: of the base colour.
        status: a line about it.
    """

    rows: GaussianRows
    environment: Mapping[str, Tensor] | None
    shading: ShadingModel
    rasterise: Rasterise
    sh_degree: int
    status: str

    @torch.no_grad()
    def render(
        self, camera: Camera, rows: Rows, environment: Mapping[str, Tensor] | None, *, depth: bool
    ) -> RenderResult:
        """All layers, on the CPU, of some of its rows in some light."""
        return render(
            rows,
            camera,
            self.rasterise,
            sh_degree=self.sh_degree,
            environment=environment,
            shading=self.shading,
            depth=depth,
        ).to("cpu")


def shown_run(run: TrainedRun) -> Shown:
    """A trained run."""
    rows = run.state.rows
    status = f"{run.recipe.name}, {run.state.step:,} steps; {len(rows):,} Gaussians"
    return Shown(rows, run.environment, run.shading, run.backend.rasterise, 3, status)


def shown_training(trainer: Trainer) -> Shown:
    """A training as it is between two steps; in stages without reflection it has no light."""
    state, steps = trainer.state, trainer.settings.steps
    stage = trainer.schedule.at(min(state.step, steps - 1)).stage
    light = state.environment.parameters if state.environment and stage.reflection else None
    status = f"{trainer.recipe.name}, step {state.step:,} of {steps:,} ({stage.name}); {len(state.rows):,} Gaussians"
    return Shown(
        state.rows,
        light,
        trainer.recipe.shading(trainer.settings.refractive_index),
        trainer.backend.rasterise,
        trainer.schedule.sh_degree(min(state.step, steps - 1)),
        status,
    )
