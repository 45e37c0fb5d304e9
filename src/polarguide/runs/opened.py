"""A run folder opened for looking at: its Gaussians, its light, and how they make pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.errors import PolarguideError
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.raster import Backend, DeviceName, choose_backend
from polarguide.recipes import recipe_named
from polarguide.shading.model import ShadingModel
from polarguide.shading.deferred import render
from polarguide.shading.result import RenderResult
from polarguide.runs.folder import CHECKPOINT, RunConfiguration, load_checkpoint
from polarguide.training.recipe import Recipe
from polarguide.training.state import TrainingState

SIDE_ROWS = {
    "strength_logits": (),
    "local_dc": (3,),
    "local_rest": (15, 3),
    "outward": (3,),
    "log_albedo": (3,),
    "roughness_logits": (),
    "features": (4,),
}
"""Side tensors that shading reads, with the shape of one row."""


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
        return self.recipe.shading(self.configuration.settings.refractive_index)

    @property
    def environment(self) -> dict[str, Tensor] | None:
        """Parameters of the learned environment; None for a recipe without."""
        return self.state.environment.parameters if self.state.environment else None

    @torch.no_grad()
    def render_camera(self, camera: Camera, *, normals: bool = True, depth: bool = False) -> RenderResult:
        """All layers from a camera; ``normals`` where the recipe can do without them, and ``depth``, on request."""
        return render(
            self.state.gaussians,
            camera,
            self.backend.rasterize,
            environment=self.environment,
            shading=self.shading,
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
    _check(folder / CHECKPOINT, state)
    return TrainedRun(folder, configuration, recipe, state, backend)


def _check(path: Path, state: TrainingState) -> None:
    """Refuse rows and texels whose shapes or values no training leaves."""
    gaussians, count = state.gaussians, len(state.gaussians)
    for name, shape in {**CORE_SHAPES, **SIDE_ROWS}.items():
        if name not in gaussians:
            if name in CORE_SHAPES:
                raise _damaged(path, f"no {name}")
        elif gaussians[name].dtype != torch.float32 or gaussians[name].shape != (count, *shape):
            raise _damaged(path, f"{name} of shape {list(gaussians[name].shape)}, {gaussians[name].dtype}")
        elif not bool(torch.isfinite(gaussians[name]).all()):
            raise _damaged(path, f"{name} that are not finite")
    for name, values in (state.environment.parameters if state.environment else {}).items():
        if values.dtype != torch.float32 or not bool(torch.isfinite(values).all()):
            raise _damaged(path, f"an environment's {name} that are not finite floats")
        if name == "texels" and (
            values.ndim != 4 or values.shape[0] != 6 or values.shape[1] != values.shape[2]
        ):
            raise _damaged(path, f"an environment of shape {list(values.shape)}")


def _damaged(path: Path, found: str) -> PolarguideError:
    return PolarguideError(
        path, expected="the Gaussians of a training", found=found, remedy="Train again into a new folder."
    )
