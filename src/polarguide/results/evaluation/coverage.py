"""Coverage of held-out views: the pixels whose content at least one training view shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from polarguide.geometry.camera import Camera, seen_at

BACKGROUND_RADII = 3.0
"""Distance from the middle of the scene, in camera radii, beyond which content counts as background."""
OPAQUE = 0.5
"""Least alpha of a rendered surface. Pixels below it show background."""
DEPTH_TOLERANCE = 1.02
"""Factor by which a point may lie behind the surface of a training view and still belong to it."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of a view.

    Attributes:
        camera: camera of the view.
        depth: [H, W] float64 camera depth; infinite for background.
    """

    camera: Camera
    depth: Tensor

    def points(self) -> Tensor:
        """Return the world points [H, W, 3] of the pixels; directions instead of points for background."""
        forward = self.camera.rays(dtype=torch.float64)[..., 2]
        rays = self.camera.world_rays(dtype=torch.float64)
        surface = self.depth.isfinite()
        distance = torch.where(surface, self.depth / forward, 1.0)
        return torch.where(surface[..., None], self.camera.center, 0.0) + rays * distance[..., None]


def depth_map_of_truth(camera: Camera, depth: Tensor) -> DepthMap:
    """Return the depth map of a ground truth [H, W], in which 0 marks background."""
    values = depth.double()
    return DepthMap(camera, torch.where(values > 0, values, torch.inf))


def depth_map_of_rendering(
    camera: Camera, depth: Tensor, alpha: Tensor, middle: Tensor, radius: float
) -> DepthMap:
    """Return the depth map of a rendering.

    Args:
        camera: camera of the view.
        depth: [H, W] rendered camera depth.
        alpha: [H, W] rendered alpha.
        middle: [3] middle of the scene.
        radius: distance of the cameras from the middle.
    """
    finite = DepthMap(camera, depth.double().cpu())
    remote = (finite.points() - middle).norm(dim=-1) > BACKGROUND_RADII * radius
    background = remote | (alpha.cpu() < OPAQUE) | (finite.depth <= 0)
    return DepthMap(camera, torch.where(background, torch.inf, finite.depth))


class Coverage:
    """Record of the held-out pixels that training views show.

    A training view shows a surface point if the point lies in its picture and no nearer surface hides it. It shows
    the background in a direction if the pixel of that direction is background there, too.

    Args:
        held_out: depth maps of the held-out views by name.
    """

    def __init__(self, held_out: Mapping[str, DepthMap]) -> None:
        self._surfaces = {name: item.depth.isfinite() for name, item in held_out.items()}
        self._points = {name: item.points() for name, item in held_out.items()}
        self.seen = {name: torch.zeros_like(surface) for name, surface in self._surfaces.items()}
        """Masks [H, W] by view: True if a training view that was added shows the pixel's content."""

    def add(self, training: DepthMap) -> None:
        """Mark the pixels that a training view shows."""
        camera = training.camera
        # The farthest depth of the neighborhood: at an edge a pixel may show either surface.
        edges = training.depth.nan_to_num(posinf=torch.finfo(torch.float64).max)[None, None]
        farthest = functional.max_pool2d(edges, 3, stride=1, padding=1)[0, 0]
        background = functional.max_pool2d(training.depth.isinf().double()[None, None], 3, 1, 1)[0, 0] > 0
        for name, seen in self.seen.items():
            open_pixels = ~seen
            surface = self._surfaces[name][open_pixels]
            points = self._points[name][open_pixels]
            offsets = torch.where(surface[:, None], points - camera.center, points)
            pixels, depth, inside = seen_at(offsets, camera)
            visible = torch.where(surface, depth <= DEPTH_TOLERANCE * farthest[pixels], background[pixels])
            seen[open_pixels] = inside & visible
