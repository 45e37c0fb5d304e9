"""Surface of a splatted picture: position and normal around the median depth of each pixel.

A pixel at an edge shows two surfaces, and its blended depth and normal lie between them. This module averages only the
Gaussians around the median depth, which belong to one of the surfaces.

``alpha_in_front`` renders the alpha in front of given depths.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera, seen_at
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


@torch.no_grad()
def alpha_in_front(splats: Splats, camera: Camera, depth: Tensor, rasterize: Rasterize) -> Tensor:
    """Return the alpha of the Gaussians whose centers lie in front of the depth at their pixel.

    Gaussians with centers outside the picture, or at pixels without a depth, do not count. Wide Gaussians of the ground
    below a picture would count otherwise.

    Args:
        splats: the Gaussians; features are ignored.
        camera: the view.
        depth: [H, W] camera depths; 0 or less for pixels without a depth.
        rasterize: rasterizer of the backend.

    Returns:
        Alpha [H, W] in [0, 1]; 0 without Gaussians.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    pixels, places, inside = seen_at(splats.means - pose.center, camera)
    front = inside & (places < depth.to(places)[pixels])
    features = splats.features.new_zeros(len(places), 1)
    return rasterize(Splats(*(part[front] for part in splats._replace(features=features))), camera).alpha
