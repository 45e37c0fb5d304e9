"""Free space: the space just in front of the cameras, where no surface can be.

A Gaussian close to one camera explains that one picture and occludes every new view nearby. The SfM points bound the
distance of the nearest surface of a view; well before it, space is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.camera import Camera


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Balls about the cameras.

    Attributes:
        centers: [V, 3]. radii: [V], 0 for a camera that sees no point.
    """

    centers: Tensor
    radii: Tensor

    def to(self, device: torch.device) -> FreeSpace:
        """The same free space on a device."""
        return FreeSpace(self.centers.to(device), self.radii.to(device))

    def contains(self, means: Tensor) -> Tensor:
        """Which of the positions [N, 3] lie in it, [N] bool."""
        return (torch.cdist(means, self.centers) < self.radii).any(dim=1)


def free_space(points: Tensor, cameras: Sequence[Camera], share: float, quantile: float) -> FreeSpace:
    """The free space in front of cameras that see SfM points [M, 3].

    Args:
        share: of the depth of a view's nearest points, which is free. quantile: of depths, which is the nearest.
    """
    radii = []
    for camera in cameras:
        x, y, z = camera.to_camera(points.double() - camera.center).unbind(-1)
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        depths = z[inside]
        radii.append(share * float(torch.quantile(depths, quantile)) if len(depths) else 0.0)
    centers = torch.stack([camera.center for camera in cameras]).float()
    return FreeSpace(centers, torch.tensor(radii))
