"""Normals and depth should tell the same surface (2D Gaussian splatting, Huang et al. 2024, Eq. 14)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.camera import Camera
from polarguide.shading.result import RenderResult
from polarguide.vectors import dot, unit


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Unit normals of a depth picture by central differences, facing the camera.

    Args:
        depth: [H, W] camera depth, positive.
        camera: of the picture.

    Returns:
        [H, W, 3] in world axes, differentiable; zero on the border and where three points lie on a line.
    """
    rays = camera.rays(dtype=depth.dtype, device=depth.device)
    points = rays / rays[..., 2:] * depth[..., None]
    # In units of the depth, so that the length that ``unit`` takes for zero means the same near and far.
    scale = 1 / depth.detach().clamp(min=1e-6)[1:-1, 1:-1, None]
    across = (points[1:-1, 2:] - points[1:-1, :-2]) * scale
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) * scale
    return pad(camera.to_world(unit(torch.linalg.cross(down, across))), (0, 0, 1, 1, 1, 1))


def consistency_loss(result: RenderResult, camera: Camera, weight: Tensor | None = None) -> Tensor:
    """Mean of ``alpha - n . n_depth``: 0 where blended normals agree with each other and with the depth.

    Args:
        result: with the blended normal ``n`` (unit normals times weights that add up to alpha) and the depth.
        camera: of the view.
        weight: [H, W] where it counts; None: everywhere.
    """
    assert result.normal is not None
    assert result.depth is not None
    cosine = dot(result.normal, depth_normals(result.depth, camera))
    distance = result.alpha.detach() - cosine
    return (distance if weight is None else weight * distance)[1:-1, 1:-1].mean()
