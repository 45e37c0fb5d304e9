"""Texture coordinates by xatlas in a separate process, because a running xatlas cannot be interrupted."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.progress import Reporter

PADDING = 256
"""Size of the mip map in which charts are one texel apart, which gives 8 texels at 2,048."""
SLACK = 1.25
"""Factor on the requested padding, because xatlas scales an oversized atlas down."""
SLOW = 300_000
"""Number of triangles above which xatlas is slow. Its time grows faster than linearly."""
_ENTRY = "from polarguide.results.export.model.unwrap import run_xatlas; run_xatlas()"


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Mesh whose vertices are split along the borders of charts.

    Attributes:
        source: [W] original vertex of each vertex. faces: [F, 3] of the new vertices.
        uv: [W, 2] in [0, 1], with v from the first row of the texture. charts: number of charts.
    """

    source: NDArray[np.int64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64]
    charts: int


def unwrap(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], texture: int, folder: Path, reporter: Reporter
) -> Unwrapped:
    """Cut a mesh into charts and pack them into a square texture.

    Args:
        vertices: [V, 3]. faces: [F, 3]. texture: texels along its side.
        folder: folder for exchanged files. reporter: receives progress, and a warning about many triangles.

    Raises:
        PolarguideError: xatlas fails, for example because of insufficient memory.
    """
    if len(faces) > SLOW:
        reporter.warn(
            f"xatlas may take more than an hour for {len(faces):,} triangles; reduce them to --triangles {SLOW}."
        )
    task = folder / "mesh.npz"
    answer = folder / "atlas.npz"
    np.savez(task, vertices=vertices.astype(np.float32), faces=faces.astype(np.uint32), texture=texture)
    with reporter.track(f"unwrapping {len(faces):,} triangles (xatlas)"):
        command = [sys.executable, "-c", _ENTRY, str(task), str(answer)]
        process = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    if process.returncode or not answer.is_file():
        lines = process.stderr.decode(errors="replace").strip().splitlines()
        raise PolarguideError(
            "xatlas",
            expected="texture coordinates",
            found=(lines or [f"exit status {process.returncode}"])[-1][:200],
            remedy="Reduce --triangles.",
        )
    with np.load(answer) as atlas:
        return Unwrapped(
            atlas["source"].astype(np.int64),
            atlas["faces"].astype(np.int64),
            atlas["uv"].astype(np.float64),
            int(atlas["charts"]),
        )


def run_xatlas() -> None:
    """Unwrap the mesh in the first file of the command line and write the atlas to the second file."""
    xatlas = optional_import("xatlas", "a textured model")
    task, answer = sys.argv[1:3]
    with np.load(task) as mesh:
        atlas: Any = xatlas.Atlas()
        atlas.add_mesh(mesh["vertices"], mesh["faces"])
        packing = xatlas.PackOptions()
        packing.resolution = int(mesh["texture"])
        packing.padding = math.ceil(SLACK * int(mesh["texture"]) / PADDING)
        packing.bilinear = True
        packing.create_image = False
        atlas.generate(xatlas.ChartOptions(), packing)
        source, faces, uv = atlas[0]
    np.savez(answer, source=source, faces=faces, uv=uv, charts=atlas.chart_count)
