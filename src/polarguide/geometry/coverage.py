"""Content that training views show: pixels of held-out views that they cover, and surfaces that they confirm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
HAZE_DEPTH = 0.8
"""Share of a surface's depth up to which alpha counts as haze. Gaussians of the surface itself are closer to it."""
GRID = 160
"""Approximate number of columns of the grid on which confirmed surfaces are computed."""


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

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the smallest and the largest depth [H, W] within 3 x 3 pixels, finite for background.

        A pixel at an edge may show either of two surfaces, whose depths are the two bounds.
        """
        depth = self.depth.nan_to_num(posinf=torch.finfo(torch.float64).max)[None, None]
        nearest, farthest = (sign * functional.max_pool2d(sign * depth, 3, 1, 1)[0, 0] for sign in (-1, 1))
        return nearest, farthest

    def on_grid(self) -> DepthMap:
        """Return the depths at the middle of squares of pixels, about ``GRID`` squares in a row."""
        factor = _square(self.camera)
        camera = self.camera.downscaled(factor)
        middles = self.depth[factor // 2 :: factor, factor // 2 :: factor]
        return DepthMap(camera, middles[: camera.height, : camera.width])


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
        _, farthest = training.bounds()
        background = farthest == torch.finfo(torch.float64).max
        for name, seen in self.seen.items():
            open_pixels = ~seen
            surface = self._surfaces[name][open_pixels]
            points = self._points[name][open_pixels]
            offsets = torch.where(surface[:, None], points - camera.center, points)
            pixels, depth, inside = seen_at(offsets, camera)
            visible = torch.where(surface, depth <= DEPTH_TOLERANCE * farthest[pixels], background[pixels])
            seen[open_pixels] = inside & visible


class ConfirmedSurfaces:
    """Surfaces at which at least two training views have the same depth.

    Space in front of such a surface is free, because light passes through it into the views. A surface that only one
    view shows is not confirmed. It counts as haze if it stands in front of a confirmed surface.

    Args:
        training: depth maps of the training views, in any resolution.
    """

    def __init__(self, training: Sequence[DepthMap]) -> None:
        grids = [view.on_grid() for view in training]
        bounds = [grid.bounds() for grid in grids]
        self._points = [
            _confirmed_points(grid, [(grids[k].camera, *bounds[k]) for k in range(len(grids)) if k != place])
            for place, grid in enumerate(grids)
        ]

    def nearest(self, camera: Camera) -> Tensor:
        """Return the depth [H, W] of the nearest confirmed surface in each square of the grid; 0 without one."""
        factor = _square(camera)
        grid = camera.downscaled(factor)
        depth = torch.full((grid.height * grid.width,), torch.inf, dtype=torch.float64)
        for points in self._points:
            (row, column), z, inside = seen_at(points - grid.center, grid)
            depth.scatter_reduce_(0, (row * grid.width + column)[inside], z[inside], "amin")
        nearest = torch.where(depth.isfinite(), depth, 0.0).view(grid.height, grid.width)
        rows = (torch.arange(camera.height) // factor).clamp(max=grid.height - 1)
        columns = (torch.arange(camera.width) // factor).clamp(max=grid.width - 1)
        return nearest[rows[:, None], columns]


def _square(camera: Camera) -> int:
    """Return the side in pixels of a square of the grid of a picture."""
    return max(1, camera.width // GRID)


def _confirmed_points(grid: DepthMap, others: Sequence[tuple[Camera, Tensor, Tensor]]) -> Tensor:
    """Return the world points [K, 3] of a depth map at which another view has the same depth.

    Args:
        grid: the depth map.
        others: camera of each other view, with the bounds of its depths.
    """
    points = grid.points()[grid.depth.isfinite()]
    confirmed = torch.zeros(len(points), dtype=torch.bool)
    for camera, nearest, farthest in others:
        candidates = (~confirmed).nonzero()[:, 0]
        pixels, depth, inside = seen_at(points[candidates] - camera.center, camera)
        hidden = depth > DEPTH_TOLERANCE * farthest[pixels]
        seen_through = DEPTH_TOLERANCE * depth < nearest[pixels]
        confirmed[candidates] = inside & ~hidden & ~seen_through
    return points[confirmed]
