"""Procedural geometry: the types of ``shape`` of an object.

Every shape is centered at the origin or stands on it, with z up; docs/reference/scene-files.md describes the fields.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from polarguide.geometry.vectors import unit_array as unit
from polarguide.synth.mesh import Array, Mesh, grid_faces, joined, smooth_normals, solid
from polarguide.synth.schema import make
from polarguide.synth.textures import fractal_noise


def sphere(radius: float = 1.0, detail: int = 96) -> Mesh:
    """A ball as triangles with exact normals."""
    polar = np.linspace(0, np.pi, detail // 2 + 1)
    turned = lathe([[np.sin(a), -np.cos(a)] for a in polar], segments=detail, smooth=0)
    return Mesh(radius * turned.points, turned.faces, turned.uv, unit(turned.points))


def plane(size: tuple[float, float] = (1.0, 1.0), tile: float = 0.0) -> Mesh:
    """A rectangle that looks up; ``tile`` is the length of one repeat of its texture, 0 for one over all."""
    x, y = size
    points = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) / 2
    uv = points[:, :2] / tile if tile else np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), uv, np.tile([0.0, 0, 1], (4, 1)))


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0), bevel: float = 0.0, detail: int = 4) -> Mesh:
    """A box with rounded edges; each side shows the whole texture."""
    half = np.array(size, float) / 2
    if not 0 <= bevel <= half.min():
        raise ValueError(f"a bevel of {bevel:g}, where half of the shortest side is {half.min():g}")
    round_ = min(bevel, float(half.min()) * 0.999) or 1e-5
    corner = np.tan(np.linspace(-np.pi / 4, np.pi / 4, detail + 1))
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            u, v = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            grids = []
            for k in (u, v):
                bent = round_ * (corner[: detail // 2 + 1] + 1)
                line = np.concatenate([-half[k] + bent, half[k] - bent[::-1]])
                grids.append(np.unique(np.round(line, 12)))
            a, b = np.meshgrid(*grids, indexing="ij")
            points = np.zeros((*a.shape, 3))
            points[..., u], points[..., v], points[..., axis] = a, b, sign * half[axis]
            core = np.clip(points, -(half - round_), half - round_)
            normals = unit(points - core)
            uv = np.stack((a / (2 * half[u]) + 0.5, b / (2 * half[v]) + 0.5), -1)
            points = core + round_ * normals
            faces = grid_faces(*a.shape)[:, [0, 2, 1]]
            sides.append(Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3)))
    return joined(sides)


def lathe(profile: list[list[float]], segments: int = 96, smooth: int = 8) -> Mesh:
    """A profile of (radius, height), from bottom to top on the outside, turned about z.

    ``smooth`` points are put between two points of the profile, on a Catmull-Rom curve; 0 keeps them as they are.
    """
    corners = _corners(profile, 2)
    if (corners[:, 0] < 0).any():
        raise ValueError(f"a radius of {corners[:, 0].min():g} in the profile")
    line = _curve(corners, smooth)
    line[:, 0] = np.maximum(line[:, 0], 0)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    direction = np.stack((np.cos(angle), np.sin(angle)), -1)
    points = np.empty((len(line), segments + 1, 3))
    points[..., :2] = line[:, None, :1] * direction
    points[..., 2] = line[:, None, 1]
    tangent = unit(np.gradient(line, axis=0))
    normals = np.empty_like(points)
    normals[..., :2] = tangent[:, None, 1:] * direction
    normals[..., 2] = -tangent[:, :1]
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), (along / along[-1])[:, None]), -1)
    faces = grid_faces(len(line), segments + 1)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def tube(path: list[list[float]], radius: float = 0.1, segments: int = 24, smooth: int = 8) -> Mesh:
    """A round bar along a path through points."""
    line = _curve(_corners(path, 3), smooth)
    tangent = unit(np.gradient(line, axis=0))
    side = np.empty_like(line)
    side[0] = unit(np.cross(tangent[0], [0.3, 0.5, 0.81]))
    for k in range(1, len(line)):  # carried along with the least turn
        side[k] = unit(side[k - 1] - tangent[k] * (side[k - 1] @ tangent[k]))
    up = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None]
    points = line[:, None] + radius * normals
    uv = np.stack(np.broadcast_arrays(angle[:, 0] / (2 * np.pi), np.linspace(0, 1, len(line))[:, None]), -1)
    faces = grid_faces(len(line), segments + 1)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def waves(
    size: tuple[float, float] = (1.0, 1.0),
    detail: int = 300,
    height: float = 0.01,
    length: float = 0.5,
    seed: int = 0,
) -> Mesh:
    """A rectangle that looks up with smooth random waves: ``height`` from crest to trough, ``length`` apart."""
    x, y = (np.linspace(-s / 2, s / 2, detail) for s in size)
    a, b = np.meshgrid(x, y, indexing="ij")
    z = height * (fractal_noise(np.stack((a, b * 0.6), -1) / length, seed, octaves=2) - 0.5)
    points = np.stack((a, b, z), -1)
    slope_x, slope_y = np.gradient(z, x, y)
    normals = unit(np.stack((-slope_x, -slope_y, np.ones_like(z)), -1))
    uv = np.stack((a / size[0] + 0.5, b / size[1] + 0.5), -1)
    faces = grid_faces(detail, detail)[:, [0, 2, 1]]
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def rock(radius: float = 1.0, rough: float = 0.25, seed: int = 0, detail: int = 96) -> Mesh:
    """A ball with random bumps of ``rough`` times its radius."""
    ball = sphere(1.0, detail)
    bumps = fractal_noise(ball.points * 1.3 + 10, seed, octaves=4) - 0.5
    points = radius * ball.points * (1 + 2 * rough * bumps[:, None])
    return Mesh(points, ball.faces, ball.uv, smooth_normals(points, ball.faces))


def _corners(points: list[list[float]], axes: int) -> Array:
    """Two or more points of so many numbers each, as an array."""
    try:
        corners = np.array(points, float)
    except (TypeError, ValueError):
        raise ValueError(f"points that are not all {axes} numbers") from None
    if corners.ndim != 2 or corners.shape[1] != axes or len(corners) < 2:
        raise ValueError(f"an array of shape {list(corners.shape)} where points are [2 or more, {axes}]")
    return corners


def _curve(points: Array, between: int) -> Array:
    """Points on the Catmull-Rom curve through points; its ends repeat the first and last point."""
    if between == 0 or len(points) < 3:
        return points.copy()
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = (np.arange(between + 1) / (between + 1))[:, None]
    pieces = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        pieces.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    return np.concatenate([*pieces, points[-1:]])


SHAPES: dict[str, Callable[..., Mesh]] = {
    "sphere": sphere, "plane": plane, "box": box, "lathe": lathe, "tube": tube, "waves": waves, "rock": rock,
    "solid": solid,
}  # fmt: skip


def make_mesh(shape: dict[str, Any], where: str) -> Mesh:
    """The mesh that the data of a shape describe.

    Raises:
        PolarguideError: the type or a field is unknown, or a value makes no sense.
    """
    return make(SHAPES, shape, f"{where} shape", f"a type of {', '.join([*SHAPES, 'mesh'])}")
