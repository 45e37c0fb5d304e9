"""Reduction of gradients that move Gaussians far behind the subject."""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.result import RenderResult


def fade_behind(result: RenderResult, near: float, far: float) -> RenderResult:
    """Return the same layers, but let the gradients of normal and depth not move distant Gaussians.

    At depths up to ``near``, gradients of the normal and the depth reach all parameters. Between ``near`` and ``far``
    they fade linearly in inverse depth. Beyond ``far``, the depth has no gradient, and the gradient of the normal only
    rotates Gaussians. The largest depth among the 3 x 3 neighbors of a pixel decides, because depth normals are
    differences between these neighbors.

    Args:
        result: rendering with ``normal``, ``rotation_only_normal`` and ``depth``.
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
    """Return the maximum of each row and its two neighbors, [H, W]. This is much faster than pooling."""
    largest = values.clone()
    torch.maximum(values[1:], values[:-1], out=largest[1:])
    torch.maximum(largest[:-1], values[1:], out=largest[:-1])
    return largest
