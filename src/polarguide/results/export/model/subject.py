"""Subject of a run as a clean mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import optional_import
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
"""Function that renders the surface of a view."""


def subject_surface(
    run: OpenedRun,
    surface_view: SurfaceView,
    inside: Inside | None,
    options: ModelOptions,
    resolution: int,
    reporter: Reporter,
) -> tuple[Surface, list[tuple[Camera, DepthSamples]], Box]:
    """Return the simplified surface of the subject, the depth samples of each camera, and the grid of the fusion.

    The reporter receives the counts of the surface.

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
        path: the file. vertices: [V, 3] in the axes of the file. faces: [F, 3].
        comment: text for the header, of which 80 characters are kept. It must not begin with "solid".

    Raises:
        PolarguideError: the file cannot be written.
    """
    trimesh = optional_import("trimesh", "--format stl")
    mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    header = comment.encode("ascii", "replace")[:80].ljust(80)
    write_whole(path, header + mesh.export(file_type="stl")[80:])
