"""A trained field: it renders the layers that scores and reports need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_decode
from polarguide.shading.result import RenderResult
from polarguide_bench.gnerp.field import Field
from polarguide_bench.gnerp.march import march, trace
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.gnerp.state import FieldState

CHUNK = 4096
"""Rays at a time."""


class _RayPixels(NamedTuple):
    """Of N rays: shown color [N, 3], normal [N, 3], opacity [N], and distance [N]."""

    color: Tensor
    normal: Tensor
    opacity: Tensor
    distance: Tensor


class FieldModel:
    """A trained field: a signed distance and colors.

    Args:
        state: state of the training. recipe: the method. device: where layers are rendered.
    """

    def __init__(self, state: FieldState, recipe: NeuralRecipe, device: torch.device) -> None:
        self.state = state
        self.recipe = recipe
        self.device = device
        self.field: Field = state.field
        self.field.map_distances()

    @property
    def steps(self) -> int:
        """How many steps it has been trained for."""
        return self.state.step

    @property
    def gaussians(self) -> None:
        """It has none."""

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        normals: bool = True,
        depth: bool = False,
        surface: bool = False,
    ) -> RenderResult:
        """All layers; ``depth`` only on request.

        Args:
            camera: any. normals: they come with the colors. surface: its depth is that of the surface in any case.
        """
        batches = [self._ray_pixels(*rays, depth) for rays in self._rays(camera)]
        color, normal, opacity, distance = (torch.cat(parts) for parts in zip(*batches, strict=True))
        size = (camera.height, camera.width)
        final = srgb_decode(color).view(*size, 3)
        rays = camera.rays(device=self.device)
        layers = {"final": final, "base": final, "alpha": opacity.view(size)}
        if normals:
            layers["normal"] = normal.view(*size, 3)
        if depth:
            layers["depth"] = distance.view(size) * rays[..., 2] * self.field.region.unit
        return RenderResult(layers)

    def stokes(self, result: RenderResult, camera: Camera) -> None:
        """It predicts an angle of polarization, and no Stokes vector."""

    @torch.no_grad()
    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        """Share of each pixel's opacity [H, W] that lies nearer than a depth [H, W]; 0 where that is 0 or less."""
        rays = camera.rays(device=self.device).view(-1, 3)
        far = depth.to(rays).flatten() / rays[:, 2] / self.field.region.unit
        shares = []
        for (origin, direction), reach in zip(self._rays(camera), far.split(CHUNK), strict=True):
            marched = march(self.field, origin, direction, self.recipe.sampling)
            near = (marched.weights * (marched.along < reach[:, None])).sum(dim=1)
            shares.append(near / marched.opacity.clamp(min=1e-6))
        return torch.cat(shares).view(depth.shape)

    @torch.no_grad()
    def lattice(self, axes: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Signed distances [X, Y, Z] in world units at all combinations of world coordinates, on the CPU."""
        region = self.field.region
        own = [
            ((axis.to(self.device, torch.float32)) - origin) / region.unit
            for axis, origin in zip(axes, region.center, strict=True)
        ]
        return (self.field.lattice(own) * region.unit).cpu()

    def _rays(self, camera: Camera) -> list[tuple[Tensor, Tensor]]:
        """Origins and directions of all pixels, in parts."""
        directions = camera.world_rays(device=self.device).view(-1, 3)
        center = self.field.region.inner(camera.pose(directions.dtype, self.device).center)
        return [(center.expand(len(part), 3), part) for part in directions.split(CHUNK)]

    def _ray_pixels(self, origin: Tensor, direction: Tensor, depth: bool) -> _RayPixels:
        marched = march(self.field, origin, direction, self.recipe.sampling)
        distance = marched.distance
        if depth:
            traced, hit = trace(self.field, origin, direction)
            distance = torch.where(hit, traced, distance)
        return _RayPixels(marched.color, marched.normal, marched.opacity, distance)
