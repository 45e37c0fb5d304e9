"""From where each Gaussian is seen: the side of a surface that is outside."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.camera import Camera, seen_at
from polarguide.capture import View
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import Parameters
from polarguide.shading.splatting import splats
from polarguide.vectors import unit

# A Gaussian at most this much behind the rendered surface, relative to its depth, is seen.
DEPTH_SLACK = 0.02
# Pixels that a Gaussian has to fill, counted by its blending weights, to add to a picture.
LEAST_PIXELS = 0.05
DEPTH_ALONE = RenderRequest(sh_degree=0, normals=False, depth=True)


@torch.no_grad()
def outward_directions(gaussians: Parameters, views: Iterable[View], rasterize: Rasterize) -> Tensor:
    """Sum of the unit directions to the cameras that see each Gaussian.

    A camera sees it where its center lies in the picture and not behind the rendered depth.

    Args:
        gaussians: the Gaussians. views: with the cameras. rasterize: of the backend.

    Returns:
        [N, 3]; zero where no camera sees it.
    """
    means = gaussians["means"]
    total = torch.zeros_like(means)
    for view in views:
        camera = view.camera
        depth = render(gaussians, camera, rasterize, DEPTH_ALONE).depth
        assert depth is not None
        center = camera.pose(means.dtype, means.device).center
        pixel, z, inside = seen_at(means - center, camera)
        seen = inside & (z < depth[pixel] * (1 + DEPTH_SLACK))
        total += seen[:, None] * unit(center - means)
    return total


class Touched(NamedTuple):
    """What training pictures show of each Gaussian.

    Attributes:
        views: [N] float32, to how many pictures it adds something: its blending weights there add up to
            ``LEAST_PIXELS``.
        most: [N] pixels that it fills in the picture to which it adds most, counted by its blending weights.
    """

    views: Tensor
    most: Tensor


def touched_pixels(gaussians: Parameters, cameras: Iterable[Camera], rasterize: Rasterize) -> Touched:
    """What pictures from some cameras show of each Gaussian.

    Args:
        gaussians: the Gaussians. cameras: of the pictures. rasterize: of the backend.
    """
    given = splats(gaussians)
    views = torch.zeros(len(given.means), device=given.means.device)
    most = torch.zeros_like(views)
    for camera in cameras:
        # The gradient of the summed weights with respect to a feature is the sum of its Gaussian's weights.
        with torch.enable_grad():
            features = torch.ones_like(given.features).requires_grad_()
            fixed = type(given)(*(tensor.detach() for tensor in given))
            rasterize(fixed._replace(features=features), camera).features.sum().backward()
        assert features.grad is not None
        pixels = features.grad[:, 0]
        views += (pixels >= LEAST_PIXELS).float()
        most = torch.maximum(most, pixels)
    return Touched(views, most)
