"""Pictures with smaller pixels than in the training.

The rasterizer blurs Gaussians by the size of a pixel (``BLUR`` in squared pixels), so a training makes them narrower.
With smaller pixels the blur is smaller, and the same Gaussians look like needles with gaps between them. Such a
picture is
drawn with the blur of the training: the blur of the smallest pixel at the Gaussian in any training view. Mip-Splatting
(Yu et al. 2024) limits Gaussians by the same pixel during the training.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera, seen_at
from polarguide.raster.interface import BLUR, NEAR_PLANE, Splats


def _pixel_sizes(depth: Tensor, camera: Camera) -> Tensor:
    """Return the side of a pixel at camera depths [N], in world units."""
    return depth.clamp(min=NEAR_PLANE) / (camera.fx * camera.fy) ** 0.5


@torch.no_grad()
def footprints(means: Tensor, cameras: Iterable[Camera]) -> Tensor:
    """Return the side of the smallest pixel at each Gaussian, among the cameras that show its center.

    Args:
        means: [N, 3] world positions. cameras: cameras of the training views.

    Returns:
        [N] in world units; 0 if no camera shows the Gaussian.
    """
    smallest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        center = camera.pose(means.dtype, means.device).center
        _, depth, inside = seen_at(means - center, camera)
        smallest = torch.where(inside, smallest.minimum(_pixel_sizes(depth, camera)), smallest)
    return torch.where(smallest.isfinite(), smallest, 0.0)


def as_trained(splats: Splats, camera: Camera, footprints: Tensor) -> Splats:
    """Add the blur of the training's pixels to Gaussians if the camera's pixels are smaller.

    Args:
        splats: N Gaussians. camera: camera of the picture. footprints: [N] as returned by ``footprints``.

    Returns:
        Gaussians with variances along all axes increased by the difference between both blurs.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    own = _pixel_sizes((splats.means - pose.center) @ pose.rotation[2], camera)
    difference = BLUR * (footprints.square() - own.square()).clamp(min=0)
    return splats._replace(scales=(splats.scales.square() + difference[:, None]).sqrt())
