"""Texture coordinates by xatlas, in a process of its own: it can neither report nor stop, and that can be ended."""

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
"""Charts stay one texel apart in the mip map of this size, so 8 texels apart at 2,048."""
SLACK = 1.25
"""How much more padding xatlas is asked for: its atlas can be larger than asked, and is scaled down then."""
SLOW = 300_000
"""Triangles above which xatlas takes long: its time grows faster than their number."""
_ENTRY = "from polarguide.results.export.model.unwrap import run_xatlas; run_xatlas()"


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """A mesh whose vertices are split along the borders of charts.

    Attributes:
        source: [W] which vertex of the mesh each one was. faces: [F, 3] of these.
        uv: [W, 2] in [0, 1]; v counts from the first row of the texture. charts: how many there are.
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
        folder: for the files that the two processes exchange. reporter: receives progress, and a warning of many
            triangles.

    Raises:
        PolarguideError: xatlas fails, as where memory ends.
    """
    if len(faces) > SLOW:
        reporter.warn(
            f"xatlas may take an hour and more for {len(faces):,} triangles; --triangles {SLOW} or fewer is faster."
        )
    task = folder / "mesh.npz"
    answer = folder / "atlas.npz"
    np.savez(task, vertices=vertices.astype(np.float32), faces=faces.astype(np.uint32), texture=texture)
    with reporter.track(f"unwrapping {len(faces):,} triangles (xatlas)"):
        command = [sys.executable, "-c", _ENTRY, str(task), str(answer)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
            try:
                _, errors = process.communicate()
            except BaseException:
                process.kill()
                raise
    if process.returncode or not answer.is_file():
        lines = errors.decode(errors="replace").strip().splitlines()
        raise PolarguideError(
            "xatlas",
            expected="texture coordinates",
            found=(lines or [f"exit status {process.returncode}"])[-1][:200],
            remedy="Give fewer --triangles.",
        )
    with np.load(answer) as atlas:
        return Unwrapped(
            atlas["source"].astype(np.int64),
            atlas["faces"].astype(np.int64),
            atlas["uv"].astype(np.float64),
            int(atlas["charts"]),
        )


def run_xatlas() -> None:
    """The process: reads the mesh from the first file that the command line names, writes the atlas to the second."""
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
