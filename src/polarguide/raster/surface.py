"""Where the surface is that a splatted picture shows, and which way it faces: what lies around the median depth.

A blended depth lies between the surfaces that a pixel shows at an edge, and a blended normal between theirs. Those of
the Gaussians around the pixel's median depth are of one of them.

``alpha_in_front`` tells how much of a pixel lies in front of a given depth.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import finite, native_rasterizer
from polarguide.raster.interface import Rasterize, Splats

WIDTH = 0.02
"""Standard deviation of what is taken around the median depth, as a share of it."""


class SurfacePicture(NamedTuple):
    """The surface around the median depth of each pixel.

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


SLABS = 31
"""Depths that are told apart in one pass; with what lies behind them they fill a rasterizer's channels."""
PASSES = 4


@torch.no_grad()
def alpha_in_front(splats: Splats, camera: Camera, depth: Tensor, rasterize: Rasterize) -> Tensor:
    """The blended weight of the Gaussians whose centers are nearer than a depth, over the pixel's whole weight.

    The depth at which this share reaches one half is the pixel's median depth. The rasterizer blends channels and
    not conditions, so the Gaussians are sorted into slabs of depth, one channel each: the share is then known at the
    slabs' ends. Each pass puts these where pixels' own depths lie among those that are still undecided, that is whose
    slab's two ends lie on different sides of one half, and that do not lie at an end themselves. What is undecided
    after the last pass is read off the straight line between the ends; its slab then is at most a few thousandths of
    its depth wide.

    Args:
        splats: the Gaussians; features are not read. camera: the view.
        depth: [H, W] camera depths; pixels with a depth of 0 or less are skipped. rasterize: rasterizer of the backend.

    Returns:
        [H, W] in [0, 1]; 0 where nothing is blended, and in skipped pixels.
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
    """At most ``SLABS`` depths, ascending, that have equally many of the given ones between them."""
    ordered = depths.flatten().sort().values
    places = torch.linspace(0, len(ordered) - 1, SLABS).round().long()
    return ordered[places].unique()
