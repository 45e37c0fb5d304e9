"""A run folder opened for looking at: its Gaussians, its light, and how they make pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.raster import Backend, DeviceName, choose_backend
from polarguide.recipes import recipe_named
from polarguide.shading.model import ShadingModel
from polarguide.shading.gbuffer import render
from polarguide.shading.result import RenderResult
from polarguide.runs.folder import RunConfiguration, load_checkpoint
from polarguide.training.recipe import Recipe
from polarguide.training.state import TrainingState

@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A trained run, without the scene it was trained on."""

    folder: Path
    configuration: RunConfiguration
    recipe: Recipe
    state: TrainingState
    backend: Backend

    @property
    def shading(self) -> ShadingModel:
        """How its layers combine."""
        return self.recipe.shading.bind(self.configuration.settings.refractive_index)

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light by name; empty for a recipe without."""
        return self.state.light

    @torch.no_grad()
    def render_camera(self, camera: Camera, *, normals: bool = True, depth: bool = False) -> RenderResult:
        """All layers from a camera; ``normals`` where the recipe can do without them, and ``depth``, on request."""
        return render(
            self.state.gaussians,
            camera,
            self.backend.rasterize,
            shading=self.shading,
            light=self.light,
            normals=normals,
            depth=depth,
        )


def open_trained(
    folder: Path, *, device: DeviceName = "auto", say: Callable[[str], None] = lambda _: None
) -> TrainedRun:
    """Open a run folder.

    Args:
        folder: of the run. device: what to compute on. say: told what takes long.

    Raises:
        PolarguideError: it is none, is damaged, or belongs to another version.
    """
    configuration = RunConfiguration.load(folder)
    recipe = recipe_named(configuration.recipe)
    backend = choose_backend(device, say=say)
    state = load_checkpoint(folder, recipe, backend.device)
    return TrainedRun(folder, configuration, recipe, state, backend)
