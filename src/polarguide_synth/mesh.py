"""Triangle meshes as arrays, and meshes of solids that are blended from primitives.

A solid consists of primitives. The signed distances to the primitives are combined by the polynomial smooth minimum.
Naive surface nets yield the triangles, and Newton's method moves them onto the surface. Normals are gradients of the
distance. Highlights are therefore smooth across blends.
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
        points: [V, 3] vertices.
        faces: [F, 3] indices of vertices, counter-clockwise as seen from outside.
        uv: [V, 2] texture coordinates.
        normals: [V, 3] unit shading normals, or None for flat triangles.
        palette: [N, 3] linear colors that u selects, for a shape with its own colors. None for all other shapes.
    """

    points: Array
    faces: NDArray[np.int64]
    uv: Array
    normals: Array | None = None
    palette: Array | None = None

    def moved(self, scale: float, rotation: Array, position: Array) -> Mesh:
        """Scale the mesh, then rotate it by a matrix [3, 3], then translate it."""
        normals = None if self.normals is None else self.normals @ rotation.T
        points = scale * self.points @ rotation.T + position
        return Mesh(points, self.faces, self.uv, normals, self.palette)


def joined(meshes: list[Mesh]) -> Mesh:
    """Concatenate meshes. The result has normals if all meshes have normals."""
    starts = np.cumsum([0] + [len(mesh.points) for mesh in meshes[:-1]])
    normals = [mesh.normals for mesh in meshes if mesh.normals is not None]
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(normals) if len(normals) == len(meshes) else None,
    )


def smooth_normals(points: Array, faces: NDArray[np.int64]) -> Array:
    """Compute the normal of each vertex as the area-weighted mean of the normals of its faces.

    Vertices at the same position share a normal.
    """
    _, place = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, place.reshape(-1)[faces[:, k]], across)
    return unit(total[place.reshape(-1)])


def grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the triangles [F, 3] between points on a grid of rows and columns, numbered row by row."""
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    a, b, c, d = (corner.ravel() for corner in corners)
    return np.concatenate([np.stack((a, b, d), -1), np.stack((a, d, c), -1)])


def rotation(degrees: tuple[float, float, float]) -> Array:
    """Return the matrix [3, 3] that rotates about x, then about y, then about z, by angles in degrees."""
    cx, cy, cz = np.cos(np.radians(degrees))
    sx, sy, sz = np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY file with texture coordinates ``u``, ``v``, and with normals if the mesh has them.

    Raises:
        PolarguideError: the file cannot be written.
    """
    columns = {"x y z": mesh.points, "u v": mesh.uv}
    if mesh.normals is not None:
        columns = {"x y z": mesh.points, "nx ny nz": mesh.normals, "u v": mesh.uv}
    rows = np.concatenate([*columns.values()], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"] = 3
    faces["v"] = mesh.faces
    header = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"),
        *(f"property float {name}" for name in " ".join(columns).split()),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""),
    ]
    write_whole(path, "\n".join(header).encode() + rows.tobytes() + faces.tobytes())


def primitive_distance(points: Array, part: dict[str, Any]) -> Array:
    """Compute the signed distances [...] from points [..., 3] to a primitive.

    Args:
        points: the points.
        part: data of the primitive, see ``solid``.

    Returns:
        The distances. They are exact except for an ellipsoid, for which they are a first-order approximation.

    Raises:
        ValueError: the kind is unknown.
    """
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
            height = (points - start) @ axis / length
            across = np.linalg.norm(points - start - (height / length)[..., None] * axis, axis=-1)
            sides = np.stack((across - part["radius"], np.abs(height - length / 2) - length / 2), -1)
            return _rounded_box(sides, part.get("round", 0.0))
    local = points - np.array(part["at"], float)
    if "rotation" in part:
        local = local @ rotation(tuple(part["rotation"]))
    if kind == "ellipsoid":
        size = np.array(part["size"], float)
        near = np.linalg.norm(local / size, axis=-1)
        return np.asarray(near * (near - 1) / np.maximum(np.linalg.norm(local / size**2, axis=-1), 1e-9))
    if kind == "box":
        return _rounded_box(np.abs(local) - np.array(part["size"], float), part.get("round", 0.0))
    if kind == "ring":
        across = np.linalg.norm(local[..., :2], axis=-1) - part["radius"]
        return np.asarray(np.hypot(across, local[..., 2]) - part["thick"])
    raise ValueError(f"no part of a solid is a {kind!r}")


def _rounded_box(sides: Array, radius: float) -> Array:
    """Compute the signed distance to a box with rounded edges.

    ``sides`` [..., K] contains the signed distance to each pair of opposite sides. ``radius`` is the radius of the
    edges.
    """
    sides = sides + radius
    distance = np.linalg.norm(np.maximum(sides, 0), axis=-1) + np.minimum(sides.max(-1), 0)
    return np.asarray(distance - radius)


def surface_nets(values: Array) -> tuple[Array, np.ndarray]:
    """Create the mesh of the zero level of a grid by naive surface nets (Gibson 1998).

    Args:
        values: signed distances on a grid, [X, Y, Z], negative inside.

    Returns:
        Vertices [V, 3] in units of cells; and triangles [F, 3].
    """
    inside = values < 0
    shape = tuple(n - 1 for n in values.shape)
    sums = np.zeros((*shape, 3))
    counts = np.zeros(shape)
    corners = {
        corner: values[tuple(slice(o, o + n) for o, n in zip(corner, shape, strict=True))]
        for corner in itertools.product((0, 1), repeat=3)
    }
    for (first, a), (axis, step) in itertools.product(corners.items(), enumerate(np.eye(3, dtype=int))):
        if first[axis]:
            continue
        b = corners[tuple(step + first)]
        crossed = (a < 0) != (b < 0)
        t = np.where(crossed, a / np.where(crossed, a - b, 1), 0)
        sums += np.where(crossed[..., None], np.array(first) + t[..., None] * step, 0)
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
"""Number of steps of Newton's method that move vertices onto the surface."""
COARSE = 4
"""Width of the cells of the coarse grid, in cells of the fine grid."""
FEW = 8
"""Smallest number of parts for which distances are evaluated block by block."""
BLOCK = 10
"""Width of a block of the grid in cells. Distances of a block are evaluated together."""


def solid(parts: list[dict[str, Any]], blend: float = 0.03, detail: int = 96) -> Mesh:
    """Create the mesh of a union of primitives with smooth transitions.

    Each part has a ``kind`` with these fields:

    - ``ellipsoid``: center ``at``, half axes ``size``
    - ``box``: center ``at``, half sides ``size``, radius ``round`` of the edges
    - ``capsule``: ends ``from`` and ``to``, their radii ``radius`` and ``end``
    - ``cylinder``: ends ``from`` and ``to``, ``radius``, radius ``round`` of the edges
    - ``ring``: center ``at``, axis z, ``radius``, radius ``thick`` of the tube

    Any part may also have these fields: a ``rotation`` about ``at``; ``cut`` to subtract the part; its own ``blend``;
    ``mirror`` ("x" or "y") to add a mirrored copy; and a ``color``.

    Args:
        parts: data of the primitives.
        blend: width of the transition between neighboring parts.
        detail: number of grid cells along the longest side.

    Raises:
        ValueError: a kind is unknown, or parts are missing.
        KeyError: a field is missing.
    """
    copies = [
        part if copy == 0 else _mirrored(part) for part in parts for copy in range(1 + ("mirror" in part))
    ]
    low, high = _bounds(copies)
    step = float((high - low).max()) / detail
    points, faces = surface_nets(_sampled(copies, blend, low, high, step))
    points = points * step + low - 2 * step
    for _ in range(NEWTON_STEPS):
        value = _distance(points, copies, blend, BLOCK * step)
        slope = _gradient(points, copies, blend, step * 0.05, BLOCK * step)
        move = slope * (value / np.maximum((slope * slope).sum(-1), 1e-6))[:, None]
        points = points - np.clip(move, -step, step)
    normals = unit(_gradient(points, copies, blend, step * 0.3, BLOCK * step))
    height = (points[:, 2] - low[2]) / (high - low)[2]
    uv = np.stack((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi), height), -1)
    return _colored(Mesh(points, faces, uv, normals), copies)


def _sampled(parts: list[dict[str, Any]], blend: float, low: Array, high: Array, step: float) -> Array:
    """Sample signed distances on a grid with a margin of two cells.

    Distances are exact near the surface, and coarse far from it.
    """
    counts = np.ceil((np.ceil((high - low) / step) + 5) / COARSE).astype(int) + 1
    coarse = np.stack(np.meshgrid(*(np.arange(n) * COARSE for n in counts), indexing="ij"), -1)
    values = _distance(low + step * (coarse - 2.0), parts, blend)
    for axis in range(3):
        values = np.repeat(values, COARSE, axis=axis)
    near = np.argwhere(np.abs(values) < 3 * COARSE * step)
    values[tuple(near.T)] = _distance(low + step * (near - 2.0), parts, blend, BLOCK * step)
    return values


def _mirrored(part: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a part that is mirrored as its field ``mirror`` requests."""
    axis = "xy".index(part["mirror"])
    copy = dict(part)
    for name in {"at", "from", "to", "rotation"} & set(part):
        # A reflection reverses rotations about the other axes.
        copy[name] = [-v if (k == axis) != (name == "rotation") else v for k, v in enumerate(part[name])]
    return copy


def _bounds(parts: list[dict[str, Any]]) -> tuple[Array, Array]:
    """Return the smallest and largest corner of a box around all parts, without those that are subtracted."""
    corners = []
    for part in (part for part in parts if not part.get("cut")):
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
    """Compute the signed distances [...] from points [..., 3] to the union of all parts.

    Args:
        points: the points. Their shape is [N, 3] if ``block`` is not 0.
        parts: data of the primitives.
        blend: width of the blend.
        block: width of blocks of points. To save time, a block is only compared with the parts near it. If 0, all
            points are compared with all parts.
    """
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
    relevant = apart < np.where(cut[:, None], 0, np.minimum(nearest, 0)) + reach
    result = np.empty(len(points))
    for some, mask in zip(np.split(order, ends[:-1]), relevant.T, strict=True):
        result[some] = _combined(points[some], list(itertools.compress(parts, mask)), blend)
    return result


def _combined(points: Array, parts: list[dict[str, Any]], blend: float) -> Array:
    """Compute the signed distances [...] from points [..., 3] to each part, and combine them.

    Raises:
        ValueError: parts are missing.
    """
    if not parts:
        raise ValueError("a solid needs parts")
    total = primitive_distance(points, parts[0])
    for part in parts[1:]:
        sign = -1 if part.get("cut") else 1
        distance = primitive_distance(points, part)
        total = sign * _smooth_minimum(sign * total, distance, part.get("blend", blend))
    return total


def _smooth_minimum(a: Array, b: Array, width: float) -> Array:
    if width <= 0:
        return np.minimum(a, b)
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.asarray(np.minimum(a, b) - overlap**3 * width / 6)


def _gradient(points: Array, parts: list[dict[str, Any]], blend: float, step: float, block: float) -> Array:
    """Compute the gradients [N, 3] of the distance by central differences, with points at distance ``step``."""
    slopes = []
    for offset in np.eye(3) * step:
        ahead, behind = (_distance(points + side * offset, parts, blend, block) for side in (1, -1))
        slopes.append((ahead - behind) / (2 * step))
    return np.stack(slopes, -1)


def _colored(mesh: Mesh, parts: list[dict[str, Any]]) -> Mesh:
    """Give each triangle the color of the part that is nearest to its center and has a color.

    Vertices between two colors are duplicated. Texture coordinates select a color of the palette.
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
