"""Pictures whose pixels are smaller than those of the training.

A training sees Gaussians through the blur of its pixels (``BLUR`` in squared pixels) and makes them as much narrower.
A picture with smaller pixels blurs less, so that the same Gaussians show as needles with gaps between them. It is drawn
with the blur that the training had: that of the nearest pixel that any training view has at the Gaussian. Yu et al.
2024 (Mip-Splatting) limit Gaussians by the same nearest pixel while they are trained.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera, seen_at
from polarguide.raster.interface import BLUR, NEAR_PLANE, Splats


def _pixel_sizes(depth: Tensor, camera: Camera) -> Tensor:
    """Sides of a pixel in the world at camera depths [N]."""
    return depth.clamp(min=NEAR_PLANE) / (camera.fx * camera.fy) ** 0.5


@torch.no_grad()
def footprints(means: Tensor, cameras: Iterable[Camera]) -> Tensor:
    """Sides of the smallest pixel at each Gaussian, among the cameras that have its center in the picture.

    Args:
        means: [N, 3] world positions. cameras: cameras of the training views.

    Returns:
        [N] in world units; 0 where no camera has it in the picture.
    """
    smallest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        center = camera.pose(means.dtype, means.device).center
        _, depth, inside = seen_at(means - center, camera)
        smallest = torch.where(inside, smallest.minimum(_pixel_sizes(depth, camera)), smallest)
    return torch.where(smallest.isfinite(), smallest, 0.0)


def as_trained(splats: Splats, camera: Camera, footprints: Tensor) -> Splats:
    """Gaussians with the blur of the training's pixels where those of a camera are smaller; others as they are.

    Args:
        splats: N Gaussians. camera: camera of the picture. footprints: [N], see above.

    Returns:
        With variances along all axes larger by what the blur of the picture's own pixel lacks.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    own = _pixel_sizes((splats.means - pose.center) @ pose.rotation[2], camera)
    lacking = BLUR * (footprints.square() - own.square()).clamp(min=0)
    return splats._replace(scales=(splats.scales.square() + lacking[:, None]).sqrt())
