"""What a viewer shows: a scene as it is at one moment, of which it asks for layers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from polarguide.angles.trainer import AngleTrainer
from polarguide.camera import Camera
from polarguide.gaussians.gaussians import Gaussians
from polarguide.neural.model import FieldModel
from polarguide.neural.trainer import FieldTrainer
from polarguide.raster.interface import Rasterize
from polarguide.rendering.relight import RELIT_RESOLUTION, turned_cubemap
from polarguide.runs.families import AnyTrainer
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN, Light, Parameters, ShadingModel
from polarguide.shading.result import RenderResult

FIELD_SHARE = 4
"""A field is shown with so many times fewer pixels each way: it takes seconds for a picture of full size."""


class Scenery(Protocol):
    """What a viewer asks for pictures."""

    @property
    def status(self) -> str:
        """A line about it."""

    def render(
        self,
        camera: Camera,
        *,
        depth: bool,
        surface: bool = False,
        kept: Callable[[Tensor], Tensor] | None = None,
        turn: Tensor | None = None,
    ) -> RenderResult:
        """All layers, on the CPU: see ``Shown.render``."""


@dataclass(frozen=True, eq=False)
class Shown:
    """Gaussians to be rendered.

    Attributes:
        gaussians: the Gaussians. light: learned, by name.
        shading: as it is now. rasterize: of the backend. sh_degree: of the base color.
        status: a line about it.
    """

    gaussians: Gaussians
    light: Light
    shading: ShadingModel
    rasterize: Rasterize
    sh_degree: int
    status: str

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        depth: bool,
        surface: bool = False,
        kept: Callable[[Tensor], Tensor] | None = None,
        turn: Tensor | None = None,
    ) -> RenderResult:
        """All layers, on the CPU.

        Args:
            camera: with the size of the picture. depth: whether depth is one of them.
            surface: whether normals and depth are those of the surface at the pixel's median depth.
            kept: which places [N, 3] of the scene are shown, [N] bool; None: all.
            turn: rotation [3, 3] of the light from afar, where it is radiance; None: as learned.
        """
        gaussians: Parameters = self.gaussians
        if kept is not None:
            inside = kept(self.gaussians["means"].detach())
            gaussians = {name: self.gaussians[name].detach()[inside] for name in self.gaussians.names}
        return render(
            gaussians,
            camera,
            self.rasterize,
            RenderRequest(self.sh_degree, depth=depth, at_median_depth=surface),
            shading=self.shading,
            light=self.light if turn is None else self._turned(turn),
        ).to("cpu")

    def _turned(self, turn: Tensor) -> Light:
        cubemap = self.shading.radiance_cubemap
        if cubemap is None:
            return self.light
        turned = turned_cubemap(self.light[cubemap.name].detach(), turn, RELIT_RESOLUTION)
        return {**self.light, cubemap.name: turned}


@dataclass(frozen=True, eq=False)
class ShownField:
    """A field to be rendered, at a quarter of the size. status: a line about it."""

    model: FieldModel
    status: str

    def render(
        self,
        camera: Camera,
        *,
        depth: bool,
        surface: bool = False,
        kept: Callable[[Tensor], Tensor] | None = None,
        turn: Tensor | None = None,
    ) -> RenderResult:
        """All layers, on the CPU: see ``Shown.render``. There is no light from afar to be turned."""
        small = [max(1, size // FIELD_SHARE) for size in (camera.width, camera.height)]
        view = replace(
            camera,
            width=small[0],
            height=small[1],
            fx=camera.fx * small[0] / camera.width,
            fy=camera.fy * small[1] / camera.height,
            cx=camera.cx * small[0] / camera.width,
            cy=camera.cy * small[1] / camera.height,
        )
        return self.model.render(view, depth=depth, kept=kept).to("cpu").resized(camera.width, camera.height)


def shown_run(run: OpenedRun) -> Scenery:
    """A trained run."""
    model = run.model
    status = f"{run.recipe.name}, {run.steps:,} steps; {model.size}"
    if isinstance(model, FieldModel):
        return ShownField(model, f"{status}; shown at a quarter of the size")
    model = run.gaussian_model("view")
    return Shown(model.state.gaussians, model.light, model.shading, model.backend.rasterize, 3, status)


def shown_training(trainer: AnyTrainer) -> Scenery:
    """A training as it is between two steps, Gaussians shaded as in its present stage."""
    steps = trainer.settings.steps
    if isinstance(trainer, FieldTrainer):
        model = FieldModel(trainer.state, trainer.recipe, trainer.state.field.distances.device, trained=False)
        status = f"{trainer.recipe.name}, step {trainer.state.step:,} of {steps:,}"
        return ShownField(model, f"{status}; shown at a quarter of the size")
    assert isinstance(trainer, AngleTrainer)
    state = trainer.state
    stage = trainer.schedule.at(min(state.step, steps - 1)).stage
    progress = f"step {state.step:,} of {steps:,} ({stage.name})"
    status = f"{trainer.recipe.name}, {progress}; {len(state.gaussians):,} Gaussians"
    return Shown(
        state.gaussians,
        state.light,
        trainer.shading if stage.reflection else PLAIN,
        trainer.backend.rasterize,
        trainer.schedule.sh_degree(min(state.step, steps - 1)),
        status,
    )
