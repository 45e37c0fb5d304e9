"""Depth maps to a surface: a truncated signed distance field (Curless and Levoy 1996) and its zero set."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from polarguide.camera import Camera
from polarguide.errors import PolarguideError, optional_import

TRUNCATION = 4.0  # voxels
_SLAB = 1 << 21  # voxels at a time


class NoSurfaceError(PolarguideError):
    """There is nothing that several views see."""


@dataclass(frozen=True, eq=False)
class Box:
    """A grid of voxels: ``low`` [3] is its corner, ``size`` a voxel's side, ``counts`` how many there are each way."""

    low: Tensor
    size: float
    counts: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh: vertices [V, 3] float64 in the world, faces [F, 3], normals [V, 3] outward, unit."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]


def seen_points(camera: Camera, depth: Tensor, mask: Tensor) -> Tensor:
    """World points [M, 3] float64 of the pixels in ``mask`` [H, W] at camera depths [H, W]."""
    rays = camera.rays()[mask].double()
    local = rays * (depth[mask].double() / rays[:, 2])[:, None]
    return camera.to_world(local) + camera.center


def box_around(points: Sequence[Tensor], center: Tensor, reach: float, resolution: int) -> Box:
    """The box of what the cameras look at: points [M, 3] within ``reach`` of the center, without their outermost 0.5 %.

    Raises:
        PolarguideError: nothing is there.
    """
    near = torch.cat([p[(p - center).norm(dim=1) < reach] for p in points])
    if len(near) < 100:
        raise NoSurfaceError(
            "mesh", expected="surfaces before the cameras", found="none", remedy="Train for more steps."
        )
    values = near.numpy()
    low, high = np.quantile(values, 0.005, axis=0), np.quantile(values, 0.995, axis=0)
    size = float((high - low).max()) / resolution
    low, high = low - 3 * size, high + 3 * size
    nx, ny, nz = (int(n) for n in np.maximum(2, np.ceil((high - low) / size)))
    return Box(torch.from_numpy(low), size, (nx, ny, nz))


def fuse(box: Box, views: Iterable[tuple[Camera, Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Mean signed distance in truncations, in [-1, 1], positive before the surface; and how many views saw each voxel.

    Args:
        box: the grid. views: camera, camera depth [H, W] and where it counts [H, W] bool.

    Returns:
        Both of the grid's shape, float32.
    """
    total, weight = torch.zeros(box.counts), torch.zeros(box.counts)
    nx, ny, nz = box.counts
    step = max(1, _SLAB // (ny * nz))
    axes = [box.low[k] + box.size * (torch.arange(n) + 0.5) for k, n in enumerate(box.counts)]
    for camera, depth, mask in views:
        known = torch.where(mask, depth, torch.zeros_like(depth)).flatten()
        turn, shift = camera.rotation, camera.translation
        for begin in range(0, nx, step):
            part = slice(begin, min(begin + step, nx))
            local = [
                (turn[i, 0] * axes[0][part] + shift[i]).float()[:, None, None]
                + (turn[i, 1] * axes[1]).float()[None, :, None]
                + (turn[i, 2] * axes[2]).float()[None, None, :]
                for i in range(3)
            ]
            z = local[2].clamp(min=1e-6)
            column = (local[0] / z * camera.fx + camera.cx).floor()
            row = (local[1] / z * camera.fy + camera.cy).floor()
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            place = (
                row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
            ).long()
            surface = known[place.flatten()].reshape(place.shape)
            distance = (surface - local[2]) / (TRUNCATION * box.size)
            counts = inside & (local[2] > 1e-6) & (surface > 0) & (distance > -1)
            total[part] += torch.where(counts, distance.clamp(max=1), 0.0)
            weight[part] += counts
    return total / weight.clamp(min=1), weight


def surface_of(box: Box, field: Tensor, weight: Tensor, *, least: int = 2, smallest: float = 0.01) -> Surface:
    """The zero set where enough views looked, without small loose pieces (marching cubes, Lewiner et al. 2003).

    Args:
        field, weight: as of ``fuse``. least: views that must have seen a voxel.
        smallest: pieces with fewer faces than this share of the largest are dropped.

    Raises:
        PolarguideError: scikit-image is not installed, or there is no surface.
    """
    marching_cubes: Callable[..., tuple[NDArray, NDArray, NDArray, NDArray]] = optional_import(
        "skimage.measure", "a mesh"
    ).marching_cubes
    known = (weight >= least).numpy()
    try:
        # Its normals point to smaller values, into the surface; with "descent" its faces turn outward.
        vertices, faces, inward, _ = marching_cubes(
            field.numpy(), 0.0, mask=known, gradient_direction="descent"
        )
    except (RuntimeError, ValueError):
        raise NoSurfaceError(
            "mesh", expected="a surface that several views see", found="none", remedy="Train for more steps."
        ) from None
    world = vertices.astype(np.float64) * box.size + box.low.numpy() + 0.5 * box.size
    return largest_pieces(Surface(world, faces.astype(np.int64), -inward.astype(np.float64)), smallest)


def largest_pieces(surface: Surface, smallest: float) -> Surface:
    """The connected pieces that have at least a share of the largest one's faces."""
    count = len(surface.vertices)
    ends = surface.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece[surface.faces[:, 0]], minlength=int(piece.max()) + 1)
    faces = surface.faces[sizes[piece[surface.faces[:, 0]]] >= smallest * sizes.max()]
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(surface.vertices[used], numbers.reshape(faces.shape), surface.normals[used])
