"""Fading of gradients that move Gaussians far behind the subject."""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.result import RenderResult


def fade_behind(result: RenderResult, near: float, far: float) -> RenderResult:
    """Return the same layers with gradients of normal and depth that move no far Gaussian.

    Up to ``near``, gradients of the normal and the depth reach all parameters. From there they fade linearly in inverse
    depth. From ``far`` on, the depth has no gradient, and that of the normal only turns Gaussians. A pixel is as far
    away as the farthest of its 3 x 3 neighbors, because normals of the depth are differences between these.

    Args:
        result: with ``normal``, ``rotation_only_normal`` and ``depth``.
        near, far: camera depths, 0 < near < far.
    """
    depth = result.depth.detach()
    share = shares_before(depth, near, far)
    normal = result.training["rotation_only_normal"].lerp(result.normal, share[..., None])
    return result.with_layers(normal=normal, depth=depth.lerp(result.depth, share))


def shares_before(depth: Tensor, near: float, far: float) -> Tensor:
    """Return the share [H, W] of the gradient that remains: 1 up to ``near``, 0 from ``far`` on."""
    farthest = _largest_of_three(_largest_of_three(depth).T).T.clamp(min=near)
    return ((1 / farthest - 1 / far) / (1 / near - 1 / far)).clamp(min=0)


def _largest_of_three(values: Tensor) -> Tensor:
    """Return the maximum of each row and its two neighbors, [H, W]; many times as fast as pooling."""
    largest = values.clone()
    torch.maximum(values[1:], values[:-1], out=largest[1:])
    torch.maximum(largest[:-1], values[1:], out=largest[:-1])
    return largest
