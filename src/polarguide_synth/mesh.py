"""Triangle meshes as arrays, and the meshes of implicit surfaces: primitives blended by their signed distances.

The blend is the polynomial smooth minimum. Triangles come from naive surface nets, are moved onto the surface by
Newton's method, and have the gradient of the distance as normal, so that highlights are smooth across blends.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import write_whole
from polarguide.geometry.vectors import unit_array as unit

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        points: [V, 3].
        faces: [F, 3] indices, counter-clockwise seen from outside.
        uv: [V, 2] texture coordinates.
        normals: [V, 3] unit shading normals, or None for flat triangles.
        palette: [N, 3] linear colors, side by side along u, if the shape has its own colors; else None.
    """

    points: Array
    faces: NDArray[np.int64]
    uv: Array
    normals: Array | None = None
    palette: Array | None = None

    def moved(self, scale: float, rotation: Array, position: Array) -> Mesh:
        """The mesh scaled, then rotated by a matrix [3, 3], then translated."""
        normals = None if self.normals is None else self.normals @ rotation.T
        points = scale * self.points @ rotation.T + position
        return Mesh(points, self.faces, self.uv, normals, self.palette)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one, with normals if all have normals."""
    starts = np.cumsum([0] + [len(mesh.points) for mesh in meshes[:-1]])
    normals = [mesh.normals for mesh in meshes if mesh.normals is not None]
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(normals) if len(normals) == len(meshes) else None,
    )


def smooth_normals(points: Array, faces: NDArray[np.int64]) -> Array:
    """Vertex normals: area-weighted means of face normals over all vertices at one position."""
    _, place = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, place.reshape(-1)[faces[:, k]], across)
    return unit(total[place.reshape(-1)])


def grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Triangles between points [rows, columns] in row order."""
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    a, b, c, d = (corner.ravel() for corner in corners)
    return np.concatenate([np.stack((a, b, d), -1), np.stack((a, d, c), -1)])


def rotation(degrees: tuple[float, float, float]) -> Array:
    """Rotation matrix: about x, then y, then z."""
    cx, cy, cz = np.cos(np.radians(degrees))
    sx, sy, sz = np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY with normals, where there are any, and texture coordinates ``u``, ``v``.

    Raises:
        PolarguideError: the file cannot be written.
    """
    parts = {"x y z": mesh.points, "nx ny nz": mesh.normals, "u v": mesh.uv}
    names = [name for names, part in parts.items() if part is not None for name in names.split()]
    rows = np.concatenate([part for part in parts.values() if part is not None], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_whole(path, "\n".join(header).encode() + rows.tobytes() + faces.tobytes())


def primitive_distance(points: Array, part: dict[str, Any]) -> Array:
    """Signed distance from points [..., 3] to one primitive (for an ellipsoid to first order), [...]."""
    kind = part["kind"]
    if "from" in part:
        start = np.array(part["from"], float)
        end = np.array(part["to"], float)
        axis = end - start
        along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        if kind == "capsule":
            radius = part["radius"] + (part.get("end", part["radius"]) - part["radius"]) * along
            return np.asarray(np.linalg.norm(points - start - along[..., None] * axis, axis=-1) - radius)
        if kind == "cylinder":
            length = float(np.linalg.norm(axis))
            round_ = part.get("round", 0.0)
            height = (points - start) @ axis / length
            across = np.linalg.norm(points - start - (height / length)[..., None] * axis, axis=-1)
            sides = np.stack((across - part["radius"], np.abs(height - length / 2) - length / 2), -1) + round_
            return _outside(sides) - round_
    local = points - np.array(part["at"], float)
    if "rotation" in part:
        local = local @ rotation(tuple(part["rotation"]))
    if kind == "ellipsoid":
        size = np.array(part["size"], float)
        near = np.linalg.norm(local / size, axis=-1)
        slope = np.linalg.norm(local / size**2, axis=-1)
        return np.asarray(near * (near - 1) / np.maximum(slope, 1e-9))
    if kind == "box":
        round_ = part.get("round", 0.0)
        return _outside(np.abs(local) - np.array(part["size"], float) + round_) - round_
    if kind == "ring":
        across = np.linalg.norm(local[..., :2], axis=-1) - part["radius"]
        return np.asarray(np.hypot(across, local[..., 2]) - part["thick"])
    raise ValueError(f"no part of a solid is a {kind!r}")


def _outside(sides: Array) -> Array:
    """Signed distance to a box, given the signed distances to its pairs of sides."""
    return np.asarray(np.linalg.norm(np.maximum(sides, 0), axis=-1) + np.minimum(sides.max(-1), 0))


def surface_nets(values: Array) -> tuple[Array, np.ndarray]:
    """Naive surface nets (Gibson 1998): vertices [V, 3] in units of cells, and triangles [F, 3].

    Args:
        values: signed distances on a grid, [X, Y, Z], negative inside.
    """
    inside = values < 0
    shape = tuple(n - 1 for n in values.shape)
    sums = np.zeros((*shape, 3))
    counts = np.zeros(shape)

    def values_at(corner: tuple[int, ...]) -> Array:
        return values[tuple(slice(o, o + n) for o, n in zip(corner, shape, strict=True))]

    for first in itertools.product((0, 1), repeat=3):
        for axis in (k for k in range(3) if first[k] == 0):
            a = values_at(first)
            b = values_at(tuple(1 if k == axis else first[k] for k in range(3)))
            crossed = (a < 0) != (b < 0)
            t = np.where(crossed, a / np.where(crossed, a - b, 1), 0)
            place = np.array(first) + t[..., None] * np.eye(3)[axis]
            sums += np.where(crossed[..., None], place, 0)
            counts += crossed
    used = counts > 0
    index = np.full(shape, -1)
    index[used] = np.arange(int(used.sum()))
    points = np.argwhere(used) + sums[used] / counts[used][:, None]
    faces = []
    for axis in range(3):
        order = [axis, (axis + 1) % 3, (axis + 2) % 3]
        low = inside.transpose(order)[:-1, 1:-1, 1:-1]
        high = inside.transpose(order)[1:, 1:-1, 1:-1]
        cells = index.transpose(order)
        around = [cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]]
        for mask, turned in ((low & ~high, around), (high & ~low, around[::-1])):
            quad = np.stack([corner[mask] for corner in turned], -1)
            faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return points, np.concatenate(faces)


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
    whole = [one for part in parts for one in (part, *([_mirrored(part)] if "mirror" in part else []))]
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
        value = primitive_distance(points, part)
        width = part.get("blend", blend)
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
    for offset in np.eye(3) * step:
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
