"""Where the surface is that a splatted picture shows, and which way it faces: what lies around the median depth.

A blended depth lies between the surfaces that a pixel shows at an edge, and a blended normal between theirs. Those of
the Gaussians around the pixel's median depth are of one of them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide._native import MAX_CHANNELS
from polarguide.camera import Camera
from polarguide.raster.cpu import finite, native_rasterizer
from polarguide.raster.interface import Rasterize, Splats

WIDTH = 0.02
"""Standard deviation of what is taken around the median depth, as a share of it."""


class SurfacePicture(NamedTuple):
    """What lies around the median depth of each pixel.

    Attributes:
        directions: [H, W, 3] mean of the Gaussians' directions, at most unit; zero where there is nothing.
        depth: [H, W] mean of their camera depths; 0 where there is nothing.
    """

    directions: Tensor
    depth: Tensor


@torch.no_grad()
def surface_picture(splats: Splats, camera: Camera) -> SurfacePicture:
    """The weighted means of directions and camera depths around the median depth.

    The median depth z_m of a pixel is that of the Gaussian with which the blended weights w_i, front to back, reach
    half of their sum. Weights of the means are w_i exp(-(z_m / z_i - 1)^2 / (2 s^2)), s = ``WIDTH``.

    It is computed by the native kernels, wherever the Gaussians are: it is for outputs, not for training.

    Args:
        splats: the Gaussians, their features [N, 3] directions; float32. camera: the view.

    Returns:
        Both on the device of the Gaussians, without gradients.

    Raises:
        PolarguideError: a value of the Gaussians is not finite.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    depth = ((splats.means - pose.center) @ pose.rotation[2])[:, None]
    whole = splats._replace(features=torch.cat((splats.features, depth), dim=1))
    rasterizer = native_rasterizer(camera, whole.features.shape[1], None)
    out = torch.empty(camera.height, camera.width, whole.features.shape[1])
    rasterizer.surface(*finite(*whole), WIDTH, out)
    directions, depth = out.to(splats.means.device).split((3, 1), dim=-1)
    return SurfacePicture(directions, depth[..., 0])


@torch.no_grad()
def surface_reference(splats: Splats, camera: Camera, rasterize: Rasterize) -> SurfacePicture:
    """The reference implementation of ``surface_picture``: any dtype and device, a rendering for every 32 Gaussians.

    Args:
        splats, camera: as there. rasterize: tells the weights, as what is blended of a channel for each Gaussian.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    places = (splats.means - pose.center) @ pose.rotation[2]
    order = places.argsort(stable=True)
    whole = Splats(*(t[order] for t in splats))
    alone = torch.eye(len(order), dtype=places.dtype, device=places.device)
    parts = [
        rasterize(whole._replace(features=own), camera).features for own in alone.split(MAX_CHANNELS, dim=1)
    ]
    weights = torch.cat(parts, dim=-1)
    upto, depth = weights.cumsum(dim=-1), places[order]
    reached = (upto >= upto[..., -1:] / 2) & (weights > 0)
    median = depth[reached.to(torch.uint8).argmax(dim=-1)]
    near = weights * torch.exp(-0.5 * ((median[..., None] / depth - 1) / WIDTH).square())
    near = near / near.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(near.dtype).tiny)
    return SurfacePicture(near @ whole.features, near @ depth)
