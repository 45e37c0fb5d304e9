"""Coverage of held-out views: pixels whose content is visible in at least one training view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from polarguide.geometry.camera import Camera, seen_at

BACKGROUND_RADII = 3.0
"""Distance from the middle of the scene beyond which content counts as background, in camera radii."""
OPAQUE = 0.5
"""Minimum alpha of a surface pixel. Pixels with less alpha count as background."""
DEPTH_TOLERANCE = 1.02
"""Tolerance of the visibility test: largest ratio of a point's depth to the surface depth in a training view."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of a view, for visibility tests.

    Attributes:
        camera: camera of the view.
        depth: [H, W] float64 camera depth; infinite for background.
    """

    camera: Camera
    depth: Tensor

    def points(self) -> Tensor:
        """Return the world point of each pixel, [H, W, 3]. A background pixel has a direction instead of a point."""
        forward = self.camera.rays(dtype=torch.float64)[..., 2]
        rays = self.camera.world_rays(dtype=torch.float64)
        surface = self.depth.isfinite()
        distance = torch.where(surface, self.depth / forward, 1.0)
        return torch.where(surface[..., None], self.camera.center, 0.0) + rays * distance[..., None]


def depth_map_of_truth(camera: Camera, depth: Tensor) -> DepthMap:
    """Create the depth map of true depths [H, W], in which 0 marks background."""
    values = depth.double()
    return DepthMap(camera, torch.where(values > 0, values, torch.inf))


def depth_map_of_rendering(
    camera: Camera, depth: Tensor, alpha: Tensor, middle: Tensor, radius: float
) -> DepthMap:
    """Create the depth map of a rendering.

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
    """Search for the pixels of held-out views whose content is visible in a training view.

    A training view shows a surface point if the point lies in its picture and no nearer surface hides it. It shows the
    background in a direction if its own pixel in that direction is background.

    Args:
        held_out: depth maps of the held-out views by name.
    """

    def __init__(self, held_out: Mapping[str, DepthMap]) -> None:
        self._surfaces = {name: item.depth.isfinite() for name, item in held_out.items()}
        self._points = {name: item.points() for name, item in held_out.items()}
        self.seen = {name: torch.zeros_like(surface) for name, surface in self._surfaces.items()}
        """Masks [H, W] by held-out view: True for pixels that at least one of the added training views shows."""

    def add(self, training: DepthMap) -> None:
        """Add a training view, and mark the held-out pixels whose content it shows."""
        camera = training.camera
        # The farthest depth of the neighborhood is used, because a pixel at an edge may show either surface.
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
