"""Triangle meshes as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.files import write_whole
from polarguide.vectors import unit_array

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
    return unit_array(total[place.reshape(-1)])


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> NDArray[np.int64]:
    """Triangles between points [rows, columns] in row order; ``wrap`` joins the last column to the first."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - (not wrap)), indexing="ij")
    after = (column + 1) % columns
    a, b = row * columns + column, row * columns + after
    c, d = (row + 1) * columns + column, (row + 1) * columns + after
    return np.concatenate([np.stack((a, b, d), -1).reshape(-1, 3), np.stack((a, d, c), -1).reshape(-1, 3)])


def rotation(degrees: tuple[float, float, float]) -> Array:
    """Rotation matrix: about x, then y, then z."""
    x, y, z = np.radians(degrees)
    cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY with normals, where there are any, and texture coordinates ``u``, ``v``.

    Raises:
        PolarguideError: the file cannot be written.
    """
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if mesh.normals is not None else []) + ["u", "v"]
    parts = [mesh.points] + ([mesh.normals] if mesh.normals is not None else []) + [mesh.uv]
    rows = np.concatenate(parts, axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_whole(path, "\n".join(header).encode() + rows.tobytes() + faces.tobytes())
