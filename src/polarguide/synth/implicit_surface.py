"""Meshes of implicit surfaces: primitives blended by their signed distances.

The blend is the polynomial smooth minimum. Triangles come from naive surface nets, are moved onto the surface by
Newton's method, and have the gradient of the distance as normal, so that highlights are smooth across blends.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polarguide.synth.mesh import Array, Mesh
from polarguide.synth.signed_distance import primitive_distance
from polarguide.synth.surface_nets import surface_nets
from polarguide.vectors import unit_array as unit

NEWTON_STEPS = 2
COARSE = 4
FEW = 8
BLOCK = 10
"""Side of the cubes that are evaluated together, in cells."""


def solid(parts: list[dict[str, Any]], blend: float = 0.03, detail: int = 96) -> Mesh:
    """Mesh a union of blended primitives.

    Args:
        parts: each with ``kind``: "ellipsoid" (``at``, ``size``: half axes), "box" (``at``, ``size``: half sides,
            ``round``), "capsule" (``from``, ``to``, ``radius``, and ``end``, that at ``to``), "cylinder" (``from``,
            ``to``, ``radius``, ``round``) or "ring" (``at``, ``radius``, ``thick``; about z); any with ``rotation``
            about its ``at``, ``cut`` to subtract it, ``blend`` of its own, ``mirror`` ("x" or "y": a second one) and
            ``color``.
        blend: width of the transition between neighboring parts.
        detail: grid cells along the longest side.
    """
    whole = []
    for part in parts:
        whole += [part, *([_mirrored(part)] if "mirror" in part else [])]
    low, high = _bounds(whole)
    step = float((high - low).max()) / detail
    points, faces = surface_nets(_sampled(whole, blend, low, high, step))
    points = points * step + low - 2 * step
    for _ in range(NEWTON_STEPS):
        value = _distance(points, whole, blend, BLOCK * step)
        slope = _gradient(points, whole, blend, step * 0.05, BLOCK * step)
        move = slope * (value / np.maximum((slope * slope).sum(-1), 1e-6))[:, None]
        points = points - np.clip(move, -step, step)
    normals = unit(_gradient(points, whole, blend, step * 0.3, BLOCK * step))
    span = high - low
    uv = np.stack(
        (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi), (points[:, 2] - low[2]) / span[2]), -1
    )
    return _colored(Mesh(points, faces, uv, normals), whole)


def _sampled(parts: list[dict[str, Any]], blend: float, low: Array, high: Array, step: float) -> Array:
    """Distances on a grid with a margin of two cells: exact near the surface, from a coarser grid elsewhere."""
    counts = np.ceil((np.ceil((high - low) / step) + 5) / COARSE).astype(int) + 1
    coarse = np.stack(np.meshgrid(*(np.arange(n) * COARSE for n in counts), indexing="ij"), -1)
    values = _distance(low + step * (coarse - 2.0), parts, blend)
    for axis in range(3):
        values = np.repeat(values, COARSE, axis=axis)
    near = np.argwhere(np.abs(values) < 3 * COARSE * step)
    values[tuple(near.T)] = _distance(low + step * (near - 2.0), parts, blend, BLOCK * step)
    return values


def _mirrored(part: dict[str, Any]) -> dict[str, Any]:
    axis = "xy".index(part["mirror"])
    other = dict(part)
    for name in ("at", "from", "to"):
        if name in part:
            other[name] = [-v if k == axis else v for k, v in enumerate(part[name])]
    if "rotation" in part:  # a reflection reverses turns about the other axes
        other["rotation"] = [v if k == axis else -v for k, v in enumerate(part["rotation"])]
    return other


def _bounds(parts: list[dict[str, Any]]) -> tuple[Array, Array]:
    corners = []
    for part in parts:
        if part.get("cut"):
            continue
        if "from" in part:
            reach = max(part["radius"], part.get("end", 0.0))
            centers = [part["from"], part["to"]]
        else:
            centers = [part["at"]]
            size = part.get("size") or [part["radius"] + part["thick"]] * 3
            reach = np.linalg.norm(size) if "rotation" in part else np.array(size)
        corners += [np.array(c) + s * np.ones(3) * reach for c in centers for s in (-1, 1)]
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _distance(points: Array, parts: list[dict[str, Any]], blend: float, block: float = 0.0) -> Array:
    """Signed distance of all parts; with ``block``, points [N, 3] are evaluated in cubes of this side, each with only
    the parts that can matter there."""
    if block <= 0 or len(parts) < FEW:
        return _combined(points, parts, blend)
    cubes, which = np.unique(np.floor(points / block).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(which.reshape(-1), minlength=len(cubes)))
    centers: Array = ((cubes + 0.5) * block).astype(np.float64)
    apart = np.stack([primitive_distance(centers, part) for part in parts])
    cut = np.array([bool(part.get("cut")) for part in parts])
    width = np.array([part.get("blend", blend) for part in parts])
    nearest = np.where(cut[:, None], np.inf, apart).min(0)
    # Twice half the diagonal of a cube, and a margin because distances to ellipsoids are not exact.
    reach = 3 * block + width[:, None] + np.maximum(nearest, 0)
    matters = apart < np.where(cut[:, None], 0, np.minimum(nearest, 0)) + reach
    result = np.empty(len(points))
    for number, (start, end) in enumerate(zip(np.concatenate([[0], ends[:-1]]), ends, strict=True)):
        some = order[start:end]
        result[some] = _combined(
            points[some], [p for p, m in zip(parts, matters[:, number], strict=True) if m], blend
        )
    return result


def _combined(points: Array, parts: list[dict[str, Any]], blend: float) -> Array:
    total: Array | None = None
    for part in parts:
        value, width = primitive_distance(points, part), part.get("blend", blend)
        if total is None:
            total = value
        elif part.get("cut"):
            total = -_smooth_minimum(-total, value, width)
        else:
            total = _smooth_minimum(total, value, width)
    if total is None:
        raise ValueError("a solid needs parts")
    return total


def _smooth_minimum(a: Array, b: Array, width: float) -> Array:
    if width <= 0:
        return np.minimum(a, b)
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.asarray(np.minimum(a, b) - overlap**3 * width / 6)


def _gradient(points: Array, parts: list[dict[str, Any]], blend: float, step: float, block: float) -> Array:
    slopes = []
    for k in range(3):
        offset = np.eye(3)[k] * step
        ahead, behind = (_distance(points + side * offset, parts, blend, block) for side in (1, -1))
        slopes.append((ahead - behind) / (2 * step))
    return np.stack(slopes, -1)


def _colored(mesh: Mesh, parts: list[dict[str, Any]]) -> Mesh:
    """Color every triangle like the colored part nearest to its center.

    Vertices between two colors are duplicated; texture coordinates select a color of the palette.
    """
    colored = [part for part in parts if "color" in part and not part.get("cut")]
    if not colored:
        return mesh
    middles: Array = mesh.points[mesh.faces].mean(1)
    which = np.stack([primitive_distance(middles, part) for part in colored], -1).argmin(-1)
    palette, number = np.unique([part["color"] for part in colored], axis=0, return_inverse=True)
    color = number.reshape(-1)[which]
    pairs, corners = np.unique(mesh.faces * len(palette) + color[:, None], return_inverse=True)
    old, shade = np.divmod(pairs, len(palette))
    uv = np.stack(((shade + 0.5) / len(palette), np.full(len(pairs), 0.5)), -1)
    normals = None if mesh.normals is None else mesh.normals[old]
    return Mesh(mesh.points[old], corners.reshape(-1, 3), uv, normals, palette)
