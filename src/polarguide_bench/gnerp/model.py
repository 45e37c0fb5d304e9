"""Model of a trained field, which renders layers for scores and reports and extracts the surface."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from polarguide.core.errors import optional_import
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.scene_frame import scene_frame
from polarguide.optics.color import srgb_decode
from polarguide.results.rendering.mesh import COARSE, Box, Surface, box_around, zero_surface
from polarguide.shading.result import RenderResult
from polarguide_bench.gnerp.march import march, trace
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.gnerp.state import FieldState

CHUNK = 4096
"""Number of rays in a batch."""


class FieldModel:
    """Trained field of signed distance and color.

    Args:
        state: state of the training.
        recipe: recipe of the training.
        device: device of the rendering.
    """

    def __init__(self, state: FieldState, recipe: NeuralRecipe, device: torch.device) -> None:
        self.state = state
        self.recipe = recipe
        self.device = device
        self.field = state.field
        self.field.map_distances()

    @property
    def steps(self) -> int:
        """Number of training steps."""
        return self.state.step

    @property
    def gaussians(self) -> None:
        """None, because a field has no Gaussians."""

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        normals: bool = True,
        depth: bool = False,
        surface: bool = False,
    ) -> RenderResult:
        """Render the layers of a view.

        Args:
            camera: the camera.
            normals: also render normals.
            depth: also render depth.
            surface: not used, because the depth is always the depth of the surface.
        """
        batches = [self._render_rays(*rays, depth) for rays in self._rays(camera)]
        color, normal, opacity, distance = (torch.cat(parts) for parts in zip(*batches, strict=True))
        size = (camera.height, camera.width)
        final = srgb_decode(color).view(*size, 3)
        layers = {"final": final, "base": final, "alpha": opacity.view(size)}
        if normals:
            layers["normal"] = normal.view(*size, 3)
        if depth:
            rays = camera.rays(device=self.device)
            layers["depth"] = distance.view(size) * rays[..., 2] * self.field.region.unit
        return RenderResult(layers)

    def stokes(self, result: RenderResult, camera: Camera) -> None:
        """Return None, because a field predicts an angle of polarization, but no Stokes vector."""

    @torch.no_grad()
    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        """Return the opacity [H, W] in front of the depths [H, W]; 0 at depths up to 0."""
        rays = camera.rays(device=self.device).view(-1, 3)
        far = depth.to(rays).flatten() / rays[:, 2] / self.field.region.unit
        opacities = []
        for (origin, direction), reach in zip(self._rays(camera), far.split(CHUNK), strict=True):
            marched = march(self.field, origin, direction, self.recipe.sampling)
            opacities.append((marched.weights * (marched.along < reach[:, None])).sum(dim=1))
        return torch.cat(opacities).view(depth.shape)

    @torch.no_grad()
    def lattice(self, axes: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Compute signed distances [X, Y, Z] in world units at all combinations of world coordinates, on the CPU."""
        region = self.field.region
        own = [
            ((axis.to(self.device, torch.float32)) - origin) / region.unit
            for axis, origin in zip(axes, region.center, strict=True)
        ]
        return (self.field.lattice(own) * region.unit).cpu()

    def _rays(self, camera: Camera) -> list[tuple[Tensor, Tensor]]:
        """Return the origins and directions of the rays of all pixels, in batches."""
        directions = camera.world_rays(device=self.device).view(-1, 3)
        center = self.field.region.inner(camera.pose(directions.dtype, self.device).center)
        return [(center.expand(len(part), 3), part) for part in directions.split(CHUNK)]

    def _render_rays(self, origin: Tensor, direction: Tensor, depth: bool) -> tuple[Tensor, ...]:
        """Render display color [N, 3], normal [N, 3], opacity [N] and distance [N] of rays."""
        marched = march(self.field, origin, direction, self.recipe.sampling)
        distance = marched.distance
        if depth:
            traced, hit = trace(self.field, origin, direction)
            distance = torch.where(hit, traced, distance)
        return marched.color, marched.normal, marched.opacity, distance


def implicit_surface(cameras: Mapping[str, Camera], model: FieldModel, *, resolution: int) -> Surface:
    """Extract the surface of a model: the zero set of its distance in the pictures of at least two cameras.

    The search is limited to the sphere around the center of interest on which the cameras lie.

    Args:
        cameras: at least two cameras.
        model: model of the run.
        resolution: number of voxels along the longest side.

    Raises:
        PolarguideError: there is no surface, or a required package is missing.
    """
    optional_import("skimage.measure", "a mesh")
    frame = scene_frame(list(cameras.values()))
    reach = frame.distance
    coarse = 2 * reach / COARSE
    places, distance = _sampled(Box(frame.center - reach, coarse, (COARSE, COARSE, COARSE)), model)
    near = places[(distance.abs() < coarse) & (_in_pictures(cameras, places) >= 2)]
    box = box_around([near], frame.center, reach, resolution)
    places, distance = _sampled(box, model)
    return zero_surface(box, distance, _in_pictures(cameras, places))


def _sampled(box: Box, model: FieldModel) -> tuple[Tensor, Tensor]:
    """Return the centers [X, Y, Z, 3] of a box's voxels, and the signed distances [X, Y, Z] at these points."""
    x, y, z = (box.low[k] + box.size * (torch.arange(n) + 0.5) for k, n in enumerate(box.counts))
    return torch.stack(torch.meshgrid(x, y, z, indexing="ij"), dim=-1), model.lattice((x, y, z))


def _in_pictures(cameras: Mapping[str, Camera], places: Tensor) -> Tensor:
    """Return the number of cameras [...] whose pictures contain each position [..., 3], even if it is hidden."""
    counts = torch.zeros(places.shape[:-1])
    for camera in cameras.values():
        for part, count in zip(places, counts, strict=True):
            count += seen_at((part - camera.center).view(-1, 3), camera)[2].view(count.shape)
    return counts
