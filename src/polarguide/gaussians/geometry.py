"""Geometry of Gaussians: rotations, the normals of flat ones, and directions mirrored at them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize

from polarguide import _native
from polarguide.core.native import fits
from polarguide.geometry.vectors import dot, unit

GRAZING = 0.35
"""Cosine of the angle between a normal and the direction to the camera.

Below it, the sign of the normal depends on ``outward`` and not on the camera.
"""


def quaternions_to_rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices [..., 3, 3] of quaternions (w, x, y, z) [..., 4], which are normalized first."""
    w, x, y, z = normalize(quaternions, dim=-1, eps=1e-12).unbind(-1)
    entries = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in entries], dim=-2)


def shortest_axis_normals_reference(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, center: Tensor, outward: Tensor | None = None
) -> Tensor:
    """Compute ``shortest_axis_normals`` in plain torch: the reference implementation, for any dtype and device."""
    # Component by component: reductions over three or four, and one-hot vectors, are several times slower.
    w, x, y, z = quaternions.unbind(-1)
    first, second, third = log_scales.detach().unbind(-1)
    is_first = (first <= second) & (first <= third)
    is_second = ~is_first & (second <= third)
    ax = is_first.to(w)
    ay = is_second.to(w)
    az = 1 - ax - ay
    length = x * x + y * y + z * z
    twice = 2 / (w * w + length).clamp(min=1e-24)
    along = x * ax + y * ay + z * az
    diagonal = 1 - twice * length
    normals = torch.stack(
        (
            diagonal * ax + twice * (x * along + w * (y * az - z * ay)),
            diagonal * ay + twice * (y * along + w * (z * ax - x * az)),
            diagonal * az + twice * (z * along + w * (x * ay - y * ax)),
        ),
        dim=-1,
    )
    with torch.no_grad():
        to_camera = center.to(means) - means
        facing = dot(to_camera, normals)
        if outward is not None:
            side = dot(outward, normals)
            # Visible opaque surfaces face the camera, up to the width of their Gaussians.
            grazing = facing.square() < GRAZING**2 * dot(to_camera, to_camera)
            facing = torch.where(grazing & (side != 0), side, facing)
        sign = torch.where(facing >= 0, 1.0, -1.0).to(normals)[:, None]
    return normals * sign


class _Axes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        log_scales: Tensor,
        center: Tensor,
        outward: Tensor | None,
    ) -> Tensor:
        means, quaternions, log_scales = (t.detach().contiguous() for t in (means, quaternions, log_scales))
        outward = None if outward is None else outward.detach().contiguous()
        out = torch.empty_like(means)
        _native.axes_forward(means, quaternions, log_scales, center, outward, GRAZING, out)
        ctx.save_for_backward(means, quaternions, log_scales, center, outward)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        means, quaternions, log_scales, center, outward = ctx.saved_tensors
        to_quaternions = torch.empty_like(quaternions)
        _native.axes_backward(
            means, quaternions, log_scales, center, outward, GRAZING, grad.contiguous(), to_quaternions
        )
        return None, to_quaternions, None, None, None


def shortest_axis_normals(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, center: Tensor, outward: Tensor | None = None
) -> Tensor:
    """Return the unit normals of flat Gaussians: the axes of their smallest scale, turned outward.

    Without ``outward``, all normals point toward the camera. This flips the normals of Gaussians just behind a
    silhouette. They then cancel normals in front of it, and the blended normal leans toward the camera. With
    ``outward``, normals keep their side.

    Args:
        means: [N, 3] centers.
        quaternions: [N, 4] (w, x, y, z), any length.
        log_scales: [N, 3] logarithms of the scales.
        center: [3] camera center.
        outward: [N, 3] direction from which each Gaussian is visible. It determines the sign at grazing angles. A zero
            vector means unknown.

    Returns:
        Normals [N, 3] in world axes, differentiable in the quaternions (Ye et al. 2024, Sec. 3.2).
    """
    center = center.detach().to(means).contiguous()
    if fits(means, quaternions, log_scales, outward):
        result: Tensor = _Axes.apply(means, quaternions, log_scales, center, outward)
        return result
    return shortest_axis_normals_reference(means, quaternions, log_scales, center, outward)


def mirrored_directions(means: Tensor, center: Tensor, normals: Tensor) -> Tensor:
    """Return the directions of rays from the camera after reflection at each Gaussian, without gradients.

    Args:
        means: [N, 3] centers.
        center: [3] camera center.
        normals: [N, 3] unit.

    Returns:
        Unit directions [N, 3]; zero for a Gaussian at the camera center.
    """
    means = means.detach()
    normals = normals.detach()
    center = center.detach().to(means)
    if fits(means, normals):
        out = torch.empty_like(means)
        _native.mirrored_forward(means.contiguous(), center.contiguous(), normals.contiguous(), out)
        return out
    rays = unit(means - center, 1e-12)
    return rays - 2 * dot(rays, normals)[..., None] * normals
