"""The subject of a run as a clean mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import write_whole
from polarguide.core.options import ModelOptions
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera
from polarguide.results.export.model.topology import Places, simplified, topology
from polarguide.results.rendering.mesh import Box, ColoredMesh, DepthSamples, Surface, fused_surface
from polarguide.results.rendering.subject import Inside
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult

SurfaceView = Callable[[Camera], RenderResult]
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def subject_surface(
    run: OpenedRun,
    surface_view: SurfaceView,
    inside: Inside | None,
    options: ModelOptions,
    resolution: int,
    reporter: Reporter,
) -> tuple[Surface, list[tuple[Camera, DepthSamples]], Box]:
    """The simplified surface of the subject, what each camera saw of it, and the grid it was fused in. The reporter
    receives its counts.

    Raises:
        PolarguideError: there is none.
    """
    surface, views, box = fused_surface(run.cameras, surface_view, resolution=resolution)
    if inside is not None:
        surface = ColoredMesh(surface, surface.vertices).within(inside(surface.vertices)).surface
    surface = simplified(surface, options.triangles, closed=options.close_bottom)
    reporter.say(counted(surface))
    return surface, views, box


def counted(surface: Surface) -> str:
    """A mesh's numbers of vertices, triangles, pieces and edges, as text."""
    counts = topology(surface.faces)
    return (
        f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, {counts.pieces} pieces; "
        f"{counts.boundary_edges:,} boundary edges, {counts.non_manifold_edges} non-manifold edges"
    )


def write_stl(path: Path, vertices: Places, faces: NDArray[np.int64], words: str) -> None:
    """Write a binary STL file.

    Args:
        path: the file. vertices: [V, 3] as the file has them. faces: [F, 3]. words: for its head, of which 80 are kept.

    Raises:
        PolarguideError: the file cannot be written.
    """
    table = np.zeros(len(faces), _TRIANGLE)
    table["corners"] = vertices[faces]
    across = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    table["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    head = words.encode("ascii", "replace")[:80].ljust(80)  # it must not begin with "solid"
    write_whole(path, head + np.uint32(len(faces)).tobytes() + table.tobytes())
