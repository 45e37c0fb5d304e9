"""GNeRP's loss terms (Li et al. 2024): color, angle of polarization, eikonal, and the guidance by covariances."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide.geometry.vectors import dot
from polarguide.optics import lens_frame


def color_loss(predicted: Tensor, measured: Tensor, dolp: Tensor) -> Tensor:
    """Mean of ``(1 - DoLP) |difference|`` of shown colors [N, 3], DoLP [N]."""
    return ((1 - dolp)[:, None] * (predicted - measured).abs()).mean()


def aolp_loss(normal: Tensor, rays: Tensor, aolp: Tensor, dolp: Tensor, *, circular: bool) -> Tensor:
    """Mean of DoLP times the difference of the predicted angle of polarization from the measured one.

    The prediction is that of specular light: perpendicular to the plane of incidence, that is the azimuth of the
    blended normal about the ray plus 90 degrees, modulo 180.

    Args:
        normal: [N, 3] blended, camera axes, any length. rays: [N, 3] unit, camera axes.
        aolp: [N] radians in [0, pi), in the lens frame. dolp: [N] in [0, 1].
        circular: ``(1 - cos 2 difference) / 2``; else, as published, the difference of the numbers in [0, pi), which
            jumps where one of them passes 180 degrees.
    """
    right, up = _across(normal, rays)
    if circular:
        # cos and sin of twice the azimuth without the azimuth; 90 degrees more turn the sign.
        square = (right * right + up * up).clamp(min=1e-12)
        cosine, sine = (up * up - right * right) / square, -2 * right * up / square
        difference = 0.5 * (1 - cosine * torch.cos(2 * aolp) - sine * torch.sin(2 * aolp))
    else:
        flat = (right * right + up * up) < 1e-12
        azimuth = torch.atan2(torch.where(flat, 0.0, up), torch.where(flat, 1.0, right))
        difference = (torch.remainder(azimuth + math.pi / 2, math.pi) - aolp).abs()
    return (dolp * difference).mean()


def eikonal_loss(slopes: Tensor) -> Tensor:
    """Mean of ``(|slope| - 1)^2`` over slopes [..., 3]."""
    return ((dot(slopes, slopes) + 1e-12).sqrt() - 1).square().mean()


def guidance_loss(
    normals: Tensor, around: Tensor, weights: Tensor, rays: Tensor, aolp: Tensor, neighbors: Tensor,
    dolp: Tensor, *, circular: bool,
) -> Tensor:  # fmt: skip
    """L1 of the covariance of normals around a ray's samples, splatted into the picture, from that of the AoLP.

    A sample has six neighbors; the covariance of their normals about its own is projected on the plane across the
    ray, [2, 2], and blended along it. That of the picture is of ``(sin, -cos)`` of the AoLP at four pixels about that
    of the ray's own, times the squared length of the blended normal across the ray. As published, (sin, -cos) turns
    its sign where the AoLP passes 180 degrees, and the normal does not; ``circular`` doubles the angles of both.

    Args:
        normals: [N, K, 3] unit, camera axes, of the samples. around: [N, K, 6, 3] of their neighbors.
        weights: [N, K] of the samples in the picture. rays: [N, 3] unit, camera axes.
        aolp: [N] radians. neighbors: [N, 4] of the neighboring pixels. dolp: [N] weight of each ray.
    """
    own = torch.stack(_across(normals, rays[:, None]), dim=-1)
    others = torch.stack(_across(around, rays[:, None, None]), dim=-1)
    length = (weights[..., None] * own).sum(dim=1).square().sum(dim=-1)
    field, weight = _vectors(aolp, circular), weights[..., None, None]
    if circular:
        own, others = _doubled(own), _doubled(others)
    predicted = (weight * _covariance(own, others)).sum(dim=1)
    measured = length[:, None, None] * _covariance(field, _vectors(neighbors, circular))
    return (dolp[:, None, None] * (predicted - measured).abs()).mean()


def _across(vectors: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Components of vectors along the lens frame of rays, image right and image up."""
    right, up = lens_frame(rays)
    return dot(vectors, right), dot(vectors, up)


def _vectors(aolp: Tensor, circular: bool) -> Tensor:
    """The normal [..., 2] across the ray that an AoLP stands for, or that with twice its angle."""
    normal = torch.stack((torch.sin(aolp), -torch.cos(aolp)), dim=-1)
    return _doubled(normal) if circular else normal


def _doubled(vectors: Tensor) -> Tensor:
    """Vectors [..., 2] with twice their angle, and the same length."""
    x, y = vectors.unbind(-1)
    length = (x * x + y * y + 1e-12).sqrt()
    return torch.stack(((x * x - y * y) / length, 2 * x * y / length), dim=-1)


def _covariance(own: Tensor, others: Tensor) -> Tensor:
    """[..., 2, 2] of vectors [..., M, 2] about [..., 2], over M - 1."""
    apart = others - own[..., None, :]
    return apart.transpose(-1, -2) @ apart / (others.shape[-2] - 1)
