"""Where a field lies: the cameras' sphere, with room for detail in its middle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.scene_frame import scene_frame

MARGIN = 1.02


@dataclass(frozen=True)
class Region:
    """The sphere around what the cameras look at in which they stand, and the unit of lengths in it.

    Attributes:
        center: [3] in the world. unit: half the side of the middle cube, in world units: half of what a picture shows
            across at the center. Within the cube, grids have their full resolution.
        radius: of the sphere, in this unit, at least 1.
    """

    center: tuple[float, float, float]
    unit: float
    radius: float

    @classmethod
    def around(cls, cameras: Sequence[Camera]) -> Region:
        """Of the cameras of a training. The unit is the median over them."""
        frame = scene_frame(cameras)
        unit = median(
            float((camera.center - frame.center).norm()) * camera.width / (2 * camera.fx)
            for camera in cameras
        )
        farthest = max(float((camera.center - frame.center).norm()) for camera in cameras)
        x, y, z = frame.center.tolist()
        return cls((x, y, z), unit, max(1.0, MARGIN * farthest / unit))

    def first_radius(self, wanted: float) -> float:
        """Of the sphere that a surface starts as: what is wanted, but no camera stands near it or in it."""
        return min(wanted, 0.5 * self.radius)

    def inner(self, points: Tensor) -> Tensor:
        """World points [..., 3] in the field's own coordinates."""
        return (points - points.new_tensor(self.center)) / self.unit

    def world(self, inner: Tensor) -> Tensor:
        """The inverse of ``inner``."""
        return inner * self.unit + inner.new_tensor(self.center)

    def cube(self, inner: Tensor) -> tuple[Tensor, Tensor]:
        """Where the grids hold a place, in [-1, 1]^3, and its derivative along each axis, both [..., 3].

        Each axis goes on as ``2 - 1/x`` beyond 1 (the contraction of Mip-NeRF 360, Barron et al. 2022, axis by axis,
        so that slopes are turned into the field's coordinates axis by axis, too).
        """
        size = inner.abs()
        outside = size.clamp(min=1)
        end = 2 - 1 / self.radius
        place = torch.where(size > 1, inner.sign() * (2 - 1 / outside), inner) / end
        return place, 1 / (outside * outside * end)

    def places(self, cube: Tensor) -> Tensor:
        """The inverse of ``cube``, along each axis by itself: coordinates [...] of places in the grids."""
        along = cube * (2 - 1 / self.radius)
        return torch.where(along.abs() > 1, along.sign() / (2 - along.abs()), along)

    def surroundings(self, inner: Tensor) -> Tensor:
        """Where the grids of the background hold places beyond the sphere [..., 3]: in a ball of radius 1."""
        distance = inner.norm(dim=-1, keepdim=True).clamp(min=self.radius)
        return inner / distance * (1 - 0.5 * self.radius / distance)

    def span(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays enter and leave the sphere, [N] each; equal where they miss it.

        Args:
            origin: [N, 3] in the field's own coordinates. direction: [N, 3] unit.
        """
        middle = -(origin * direction).sum(dim=-1)
        half = (self.radius**2 - (origin * origin).sum(dim=-1) + middle**2).clamp(min=0).sqrt()
        begin = (middle - half).clamp(min=0)
        return begin, (middle + half).clamp(min=begin)
