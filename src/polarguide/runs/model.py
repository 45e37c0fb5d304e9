"""What a run learned, as whoever scores or shows it sees it: something that renders layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.raster import Backend
from polarguide.raster.in_front import alpha_in_front
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import LAYERS, RenderResult
from polarguide.shading.splatting import splats
from polarguide.training.state import TrainingState


class Model(Protocol):
    """What every kind of model does: see ``GaussianModel`` and ``neural.model.FieldModel``."""

    @property
    def shading(self) -> ShadingModel:
        """Which layers there are, and what light is learned."""

    @property
    def device(self) -> torch.device:
        """Where layers are rendered."""

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light by name; empty where there is none."""

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers that it renders, in the order of ``LAYERS``."""

    @property
    def steps(self) -> int:
        """How many steps it has been trained for."""

    @property
    def gaussians(self) -> int | None:
        """How many Gaussians it has; None: it is made of something else."""

    @property
    def size(self) -> str:
        """How large it is, for people."""

    def render(
        self, camera: Camera, *, normals: bool = True, depth: bool = False, surface: bool = False
    ) -> RenderResult:
        """All layers.

        Args:
            camera: any. normals: also where the model can do without them. depth: only if asked for.
            surface: normals and depth are those of the surface at the pixel's median depth, see ``raster.surface``.
        """

    def stokes(self, result: RenderResult, camera: Camera) -> Tensor | None:
        """The Stokes vectors [3, H, W, 3] that a rendered picture predicts; None: it predicts none."""

    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        """Share of each pixel's alpha that lies nearer than a depth [H, W]."""


@dataclass(frozen=True, eq=False)
class GaussianModel:
    """What was learned, for whoever scores or shows it: Gaussians, their light, and how they are shaded."""

    state: TrainingState
    shading: ShadingModel
    backend: Backend

    @property
    def device(self) -> torch.device:
        """Where layers are rendered."""
        return self.backend.device

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light by name; empty for a recipe without."""
        return self.state.light

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers that it renders, in the order of ``LAYERS``."""
        return tuple(name for name in LAYERS if name in self.shading.layers)

    @property
    def steps(self) -> int:
        """How many steps it has been trained for."""
        return self.state.step

    @property
    def gaussians(self) -> int:
        """How many Gaussians it has."""
        return len(self.state.gaussians)

    @property
    def size(self) -> str:
        """How large it is, for people."""
        return f"{self.gaussians:,} Gaussians"

    @torch.no_grad()
    def render(
        self, camera: Camera, *, normals: bool = True, depth: bool = False, surface: bool = False
    ) -> RenderResult:
        """All layers: see ``Model``."""
        return render(
            self.state.gaussians,
            camera,
            self.backend.rasterize,
            RenderRequest(normals=normals, depth=depth, at_median_depth=surface),
            shading=self.shading,
            light=self.light,
        )

    @torch.no_grad()
    def stokes(self, result: RenderResult, camera: Camera) -> Tensor | None:
        """The Stokes vectors [3, H, W, 3] that a rendered picture predicts; None without both layers and a normal."""
        if any(layer is None for layer in (result.specular, result.diffuse, result.normal)):
            return None
        return self.shading.predicted_stokes(result, camera)

    @torch.no_grad()
    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        """Share of each pixel's alpha that lies nearer than a depth [H, W], see ``raster.in_front``."""
        return alpha_in_front(splats(self.state.gaussians), camera, depth, self.backend.rasterize)
