"""Cleaning of the mesh of a run's subject: simplification, removal of small pieces, and closing of holes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import optional_import
from polarguide.core.files import write_whole
from polarguide.core.options import ModelOptions
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera
from polarguide.results.rendering.mesh import (
    Box,
    ColoredMesh,
    DepthSamples,
    Inside,
    NoSurfaceError,
    Surface,
    face_pieces,
    fused_surface,
    largest_pieces,
)
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult

ISLAND = 0.01
"""Minimum number of faces of a piece, relative to the largest piece. Smaller pieces are removed."""
WELD = 1e-6
"""Distance below which vertices are merged, relative to the longest side of the mesh."""
SMALL_HOLE = 0.1
"""Largest perimeter of a hole that is closed, relative to the diagonal of the mesh.

Larger holes are regions that no camera saw.
"""

Faces = NDArray[np.int64]
Places = NDArray[np.float64]


@dataclass(frozen=True)
class Topology:
    """Numbers of edges and pieces that show if a mesh is closed and manifold.

    Attributes:
        boundary_edges: edges with one face.
        non_manifold_edges: edges with more than two faces or with inconsistent orientation.
        pieces: connected pieces.
    """

    boundary_edges: int
    non_manifold_edges: int
    pieces: int


def topology(faces: Faces) -> Topology:
    """Count the edges and pieces of faces [F, 3]."""
    directed = _directed(faces)
    _, edge, count = np.unique(_keys(np.sort(directed, axis=1)), return_inverse=True, return_counts=True)
    forward = np.bincount(edge, weights=directed[:, 0] < directed[:, 1])
    wrong = (count > 2) | ((count == 2) & (forward != 1))
    return Topology(int((count == 1).sum()), int(wrong.sum()), len(np.unique(face_pieces(faces))))


def _directed(faces: Faces) -> NDArray[np.int64]:
    """Return the directed edges of all faces, [3 F, 2]. Face f has the edges 3 f to 3 f + 2."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _keys(edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number that identifies each pair of vertices [N, 2]."""
    return edges[:, 0] << 32 | edges[:, 1]


def simplified(surface: Surface, triangles: int, *, closed: bool = False) -> Surface:
    """Simplify a surface to about the given number of triangles (Garland and Heckbert 1997) and clean it.

    Raises:
        PolarguideError: fast-simplification is not installed, or no face is left.
    """
    if len(surface.faces) <= triangles:
        return cleaned(surface.vertices, surface.faces, closed=closed)
    simplify: Any = optional_import("fast_simplification", "a textured model").simplify
    middle = surface.vertices.mean(axis=0)  # The library uses single precision.
    vertices, faces = simplify(
        np.ascontiguousarray(surface.vertices - middle, np.float32),
        np.ascontiguousarray(surface.faces, np.int32),
        target_count=triangles,
    )
    return cleaned(vertices.astype(np.float64) + middle, faces.astype(np.int64), closed=closed)


def cleaned(vertices: Places, faces: Faces, *, closed: bool = False) -> Surface:
    """Remove small pieces, close small holes, and make faces consistent.

    In the result, each edge occurs at most once in each direction.

    Args:
        vertices: vertices of the mesh.
        faces: faces of the mesh.
        closed: close holes of any size with a flat fan, such as the bottom of an object on a table.

    Raises:
        NoSurfaceError: no face is left.
    """
    vertices, faces = _welded(vertices, faces)
    faces = consistent(vertices, faces)
    if not len(faces):
        raise NoSurfaceError(
            "the model",
            expected="a surface",
            found="none",
            remedy="Train for more steps, or move the crop box.",
        )
    surface = largest_pieces(Surface(vertices, faces, np.zeros_like(vertices)), ISLAND)
    vertices, faces = _closed(surface.vertices, surface.faces, math.inf if closed else SMALL_HOLE)
    return Surface(vertices, faces, vertex_normals(vertices, faces))


def _welded(vertices: Places, faces: Faces) -> tuple[Places, Faces]:
    """Merge vertices that are nearly equal in single precision."""
    size = np.ptp(vertices, axis=0).max()
    cells = np.rint((vertices - vertices.min(axis=0)) / max(WELD * float(size), 1e-30)).astype(np.int64)
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return vertices[first], number.ravel()[faces]


def consistent(vertices: Places, faces: Faces) -> Faces:
    """Remove degenerate faces, and faces that have the same edge in the same direction as another face.

    Afterwards an edge has at most two faces, and their orientation is consistent. From faces with a common directed
    edge, the one with the best fit to its neighbors is kept, or the largest of equally good ones.
    """
    corners = np.sort(faces, axis=1)
    faces = faces[(corners[:, 0] < corners[:, 1]) & (corners[:, 1] < corners[:, 2])]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    directed = _directed(faces)
    _, edge, count = np.unique(_keys(directed), return_inverse=True, return_counts=True)
    _, either, both = np.unique(_keys(np.sort(directed, axis=1)), return_inverse=True, return_counts=True)
    # An edge of a manifold has one face on each side.
    misfits = ((count[edge] != 1) | (both[either] != 2)).reshape(-1, 3).sum(axis=1)
    rival = (count[edge] > 1).reshape(-1, 3).any(axis=1)
    oriented = [faces[~rival]]
    taken = set(_keys(_directed(faces[~rival])).tolist())
    contested = faces[rival][np.lexsort((-area[rival], misfits[rival]))]
    for face, keys in zip(contested, _keys(_directed(contested)).reshape(-1, 3).tolist(), strict=True):
        if taken.isdisjoint(keys):
            taken.update(keys)
            oriented.append(face[None])
    return np.concatenate(oriented)


def _closed(vertices: Places, faces: Faces, largest: float) -> tuple[Places, Faces]:
    """Close holes with a fan of triangles around their center.

    ``largest`` is the largest perimeter of a hole to close, relative to the diagonal of the mesh.
    """
    directed = _directed(faces)
    edges = directed[~np.isin(_keys(directed), _keys(directed[:, ::-1]))]
    limit = largest * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    added: list[Places] = []
    new_faces: list[tuple[int, int, int]] = []
    for loop in _loops(edges.tolist()):
        places = vertices[loop]
        if np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1).sum() > limit:
            continue
        middle = len(vertices) + len(added)
        added.append(places.mean(axis=0))
        new_faces += [(b, a, middle) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)]
    if not added:
        return vertices, faces
    return np.concatenate([vertices, added]), np.concatenate([faces, np.array(new_faces, np.int64)])


def _loops(edges: list[list[int]]) -> list[list[int]]:
    """Decompose boundary edges into simple cycles. Each vertex must have as many incoming as outgoing edges.

    Holes that touch at a vertex become separate cycles. Otherwise an edge of a fan would have a third face.
    """
    following: dict[int, list[int]] = {}
    for begin, end in edges:
        following.setdefault(begin, []).append(end)
    loops = []
    for start in following:
        path = [start]
        place = {start: 0}
        while following[path[-1]]:
            at = following[path[-1]].pop()
            if at in place:
                loops.append(path[place[at] :])
                for passed in path[place[at] + 1 :]:
                    del place[passed]
                del path[place[at] + 1 :]
            else:
                place[at] = len(path)
                path.append(at)
    return loops


def vertex_normals(vertices: Places, faces: Faces) -> Places:
    """Return unit normals [V, 3] of vertices: the area-weighted mean over adjacent faces, or +z if they cancel."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-300), [[0.0, 0.0, 1.0]])


SurfaceView = Callable[[Camera], RenderResult]
"""Function that renders the surface of a view."""


def subject_surface(
    run: OpenedRun,
    surface_view: SurfaceView,
    inside: Inside | None,
    options: ModelOptions,
    resolution: int,
    reporter: Reporter,
) -> tuple[Surface, list[tuple[Camera, DepthSamples]], Box]:
    """Return the simplified surface of the subject, the depth samples of each camera, and the grid of voxels.

    The numbers of edges and pieces are reported to ``reporter``.

    Raises:
        PolarguideError: there is no surface.
    """
    surface, views, box = fused_surface(run.cameras, surface_view, resolution=resolution)
    if inside is not None:
        surface = ColoredMesh(surface, surface.vertices).within(inside(surface.vertices)).surface
    surface = simplified(surface, options.triangles, closed=options.close_bottom)
    counts = topology(surface.faces)
    reporter.say(
        f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, {counts.pieces} pieces; "
        f"{counts.boundary_edges:,} boundary edges, {counts.non_manifold_edges} non-manifold edges"
    )
    return surface, views, box


def write_stl(path: Path, vertices: Places, faces: NDArray[np.int64], comment: str) -> None:
    """Write a binary STL file.

    Args:
        path: the file.
        vertices: [V, 3] in the axes of the file.
        faces: [F, 3].
        comment: text for the header. Only its first 80 characters are kept. It must not begin with "solid".

    Raises:
        PolarguideError: the file cannot be written.
    """
    trimesh = optional_import("trimesh", "--format stl")
    mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    header = comment.encode("ascii", "replace")[:80].ljust(80)
    write_whole(path, header + mesh.export(file_type="stl")[80:])
