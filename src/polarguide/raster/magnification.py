"""Smooth pictures at a higher magnification than in the training.

The rasterizer blurs Gaussians by about a pixel (``BLUR`` in squared pixels), and a training compensates for this by
narrower Gaussians. In a picture with smaller pixels the blur is smaller, and the narrow Gaussians look like needles
with gaps between them. Such a picture is therefore drawn with the blur of the training. For each Gaussian, this is the
blur of its smallest pixel in any training view. Mip-Splatting (Yu et al. 2024) limits Gaussians by the same pixel
during the training.
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
    """Return the side of the smallest training pixel at each Gaussian, among the cameras that show its center.

    Args:
        means: [N, 3] world positions.
        cameras: cameras of the training views.

    Returns:
        Sides [N] in world units; 0 if no camera shows the Gaussian.
    """
    smallest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        center = camera.pose(means.dtype, means.device).center
        _, depth, inside = seen_at(means - center, camera)
        smallest = torch.where(inside, smallest.minimum(_pixel_sizes(depth, camera)), smallest)
    return torch.where(smallest.isfinite(), smallest, 0.0)


def as_trained(splats: Splats, camera: Camera, footprints: Tensor) -> Splats:
    """Enlarge Gaussians by the blur of the training if the camera's pixels are smaller than the training pixels.

    Args:
        splats: N Gaussians.
        camera: camera of the picture.
        footprints: [N] result of ``footprints``.

    Returns:
        Gaussians whose variances along all axes are increased by the difference between the two blurs.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    own = _pixel_sizes((splats.means - pose.center) @ pose.rotation[2], camera)
    difference = BLUR * (footprints.square() - own.square()).clamp(min=0)
    return splats._replace(scales=(splats.scales.square() + difference[:, None]).sqrt())
