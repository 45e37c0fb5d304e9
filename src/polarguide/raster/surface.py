"""Surface of a splatted picture: position and normal around the median depth of each pixel.

A pixel at an edge shows two surfaces, and its blended depth and normal lie between them. This module averages only the
Gaussians around the median depth, which belong to one of the surfaces.

``alpha_in_front`` returns the share of a pixel in front of a given depth.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import finite, native_rasterizer
from polarguide.raster.interface import Rasterize, Splats

WIDTH = 0.02
"""Standard deviation of the weights around the median depth, as a share of this depth."""


class SurfacePicture(NamedTuple):
    """Surface around the median depth of each pixel.

    Attributes:
        directions: [H, W, 3] mean direction of the Gaussians, of at most unit length; zero without Gaussians.
        depth: [H, W] mean camera depth of the Gaussians; 0 without Gaussians.
    """

    directions: Tensor
    depth: Tensor


@torch.no_grad()
def surface_picture(splats: Splats, camera: Camera) -> SurfacePicture:
    """Return the weighted means of directions and camera depths around the median depth.

    The blending weights w_i of a pixel are summed front to back. The Gaussian at which the sum reaches half of its
    final value has the median depth z_m. A Gaussian at depth z_i then has the weight w_i exp(-(z_m / z_i - 1)^2 / (2
    s^2)) in both means, with s = ``WIDTH``.

    Native kernels on the CPU compute the means for Gaussians on any device. They are used for output, not for training.

    Args:
        splats: the Gaussians, float32. Their features are directions [N, 3].
        camera: the view.

    Returns:
        Surface on the device of the Gaussians, without gradients.

    Raises:
        PolarguideError: a value of the Gaussians is not finite.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    depth = ((splats.means - pose.center) @ pose.rotation[2])[:, None]
    features = torch.cat((splats.features, depth), dim=1)
    rasterizer = native_rasterizer(camera, features.shape[1], None)
    out = torch.empty(camera.height, camera.width, features.shape[1])
    rasterizer.surface(*finite(*splats._replace(features=features)), WIDTH, out)
    directions, depth = out.to(splats.means.device).split((3, 1), dim=-1)
    return SurfacePicture(directions, depth[..., 0])


SLABS = 31
"""Number of depths that one pass of ``alpha_in_front`` resolves.

With one more channel for the space behind them, they use all channels of a rasterizer.
"""
PASSES = 4
"""Number of passes of ``alpha_in_front``."""


@torch.no_grad()
def alpha_in_front(splats: Splats, camera: Camera, depth: Tensor, rasterize: Rasterize) -> Tensor:
    """Return the share of each pixel's blending weights that belongs to Gaussians in front of a depth.

    At the median depth of a pixel, this share is one half. The Gaussians are sorted into slabs of depth with one
    channel for each slab. A rasterizer then returns the share at the ends of the slabs. A pixel is finished if the
    shares at both ends of its slab lie on the same side of one half, or if its depth lies at an end. Each pass chooses
    slabs by the depths of the unfinished pixels. After the last pass, the share of an unfinished pixel is interpolated
    linearly between the ends of its slab. The slab is then at most a few thousandths of its depth wide.

    Args:
        splats: the Gaussians; features are ignored.
        camera: the view.
        depth: [H, W] camera depths. Pixels with a depth of 0 or less are skipped.
        rasterize: rasterizer of the backend.

    Returns:
        Shares [H, W] in [0, 1]; 0 without Gaussians and for skipped pixels.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    places = ((splats.means - pose.center) @ pose.rotation[2])[:, None]
    covered = (depth > 0).cpu()
    limit = depth.to(splats.means.device, splats.means.dtype)
    low, high, total = (torch.zeros_like(limit) for _ in range(3))
    start = torch.zeros_like(limit)
    end = torch.full_like(limit, torch.inf)
    open_pixels = covered
    for _ in range(PASSES):
        if not bool(open_pixels.any()):
            break
        ends = _spread(limit.cpu()[open_pixels]).to(limit)
        slab = torch.searchsorted(ends, places.contiguous(), right=True)
        features = torch.zeros(len(places), len(ends) + 1, dtype=limit.dtype, device=limit.device)
        features.scatter_(1, slab, 1.0)
        weights = rasterize(splats._replace(features=features), camera).features
        upto = torch.cat((torch.zeros_like(weights[..., :1]), weights.cumsum(dim=-1)), dim=-1)
        bounds = torch.cat((ends.new_zeros(1), ends, ends.new_full((1,), torch.inf)))
        at = torch.searchsorted(ends, limit, right=True)[..., None]
        now = open_pixels.to(limit.device)
        for values, bound in ((low, upto.gather(-1, at)), (high, upto.gather(-1, at + 1))):
            values[now] = bound[..., 0][now]
        start[now], end[now] = bounds[at[..., 0]][now], bounds[at[..., 0] + 1][now]
        total[now] = upto[..., -1][now]
        half = total / 2
        undecided = (low < half) & (high >= half) & (limit > start) & (end > start * (1 + 1e-3))
        open_pixels = covered & undecided.cpu()
    along = torch.where(end.isfinite(), (limit - start) / (end - start).clamp(min=1e-12), 0.0)
    share = (low + along * (high - low)) / total.clamp(min=1e-12)
    return torch.where(covered.to(total.device) & (total > 0), share.clamp(0, 1), 0.0)


def _spread(depths: Tensor) -> Tensor:
    """Return at most ``SLABS`` ascending depths that divide the given depths into groups of equal size."""
    ordered = depths.flatten().sort().values
    places = torch.linspace(0, len(ordered) - 1, SLABS).round().long()
    return ordered[places].unique()
