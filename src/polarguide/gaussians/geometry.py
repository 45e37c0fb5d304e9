"""What a Gaussian's shape says: its normal, and its values on the scale they are used."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

# Cosine of the angle to the camera under which the outward side decides, not the camera.
GRAZING = 0.35


def quaternions_to_rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions (w, x, y, z) [..., 4], normalised first."""
    w, x, y, z = normalize(quats, dim=-1, eps=1e-12).unbind(-1)
    entries = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in entries], dim=-2)


def shortest_axis_normals(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, centre: Tensor, outward: Tensor | None = None
) -> Tensor:
    """Unit normals of flat Gaussians: the axis of the smallest scale, turned outward.

    Without ``outward``, outward is towards the camera. At a silhouette that turns the Gaussians just beyond it over, so
    that they cancel those just before it and the blended normal leans to the camera; with it they stay as they are.

    Args:
        means: [N, 3]. quaternions: [N, 4] (w, x, y, z), any length. log_scales: [N, 3]. centre: [3] camera centre.
        outward: [N, 3] direction from which each is seen, which decides at grazing angles; zero where not known.

    Returns:
        [N, 3] world axes, differentiable in the quaternions (Ye et al. 2024, Sec. 3.2).
    """
    q = normalize(quaternions, dim=-1, eps=1e-12)
    axis = torch.nn.functional.one_hot(log_scales.detach().argmin(dim=-1), 3).to(q)
    w, u = q[:, :1], q[:, 1:]
    cross = torch.linalg.cross(u, axis)
    normals = axis + 2 * (w * cross + torch.linalg.cross(u, cross))
    facing = (normalize(centre.to(means) - means.detach(), dim=-1) * normals.detach()).sum(
        dim=-1, keepdim=True
    )
    if outward is not None:
        side = (outward.detach() * normals.detach()).sum(dim=-1, keepdim=True)
        # An opaque surface does not face away from a camera that sees it by more than its Gaussians' width.
        facing = torch.where((facing.abs() < GRAZING) & (side != 0), side, facing)
    return torch.where(facing >= 0, normals, -normals)
