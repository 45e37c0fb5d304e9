"""Fading of gradients that move Gaussians far behind the subject."""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.result import RenderResult


def turned_behind(result: RenderResult, near: float, far: float) -> RenderResult:
    """The same pictures, whose normal and depth move no Gaussian far away.

    Gradients of the normal and the depth reach everything up to ``near``; from there they fade, linearly in inverse
    depth, and from ``far`` on the depth has none, and the normal one that turns Gaussians alone. A pixel is as far away
    as the farthest of its 3 x 3 neighbors, since the normals of the depth look at these.

    Args:
        result: with ``normal``, ``rotation_only_normal`` and ``depth``.
        near, far: camera depths, 0 < near < far.
    """
    depth = result.depth.detach()
    share = shares_before(depth, near, far)
    rotation_only = result.training["rotation_only_normal"]
    return result.with_layers(
        normal=rotation_only.lerp(result.normal, share[..., None]), depth=depth.lerp(result.depth, share)
    )


def shares_before(depth: Tensor, near: float, far: float) -> Tensor:
    """From 1 up to ``near`` to 0 from ``far`` on, of the farthest of the 3 x 3 neighbors; [H, W] like the depth."""
    farthest = _largest_of_three(_largest_of_three(depth).T).T.clamp(min=near)
    return ((1 / farthest - 1 / far) / (1 / near - 1 / far)).clamp(min=0)


def _largest_of_three(values: Tensor) -> Tensor:
    """Return the maximum of each row and its two neighbors, [H, W]; many times as fast as pooling."""
    largest = values.clone()
    torch.maximum(values[1:], values[:-1], out=largest[1:])
    torch.maximum(largest[:-1], values[1:], out=largest[:-1])
    return largest
