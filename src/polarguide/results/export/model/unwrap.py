"""Texture atlas of a mesh: texture coordinates, positions of the texels on the surface, and filling of textures.

xatlas runs in a separate process, because it cannot be interrupted.
"""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.progress import Reporter

PADDING = 256
"""Size of the mip map level in which charts are one texel apart. At 2,048 texels their distance is 8 texels."""
SLACK = 1.25
"""Factor on the requested padding, because xatlas scales down an atlas that is too large."""
SLOW = 300_000
"""Number of triangles above which xatlas is slow. Its time grows faster than linearly."""
_ENTRY = "from polarguide.results.export.model.unwrap import run_xatlas; run_xatlas()"


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Mesh with texture coordinates, whose vertices are split along the borders of its charts.

    Attributes:
        source: [W] index of the original vertex for each vertex.
        faces: [F, 3] indices of the split vertices.
        uv: [W, 2] in [0, 1]. v is 0 at the first row of the texture.
        charts: number of charts.
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
        vertices: [V, 3].
        faces: [F, 3].
        texture: texels along its side.
        folder: folder for exchanged files.
        reporter: receives progress, and a warning about many triangles.

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
    """Unwrap a mesh in a separate process.

    The command line names the file of the mesh and the file to which the atlas is written.
    """
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


_CANDIDATES = 1 << 21  # pairs of triangle and texel per batch, about 200 MB


@dataclass(frozen=True, eq=False)
class Texels:
    """Texels of a square texture whose centers lie on a triangle, M in number.

    Attributes:
        size: texels along the texture's side.
        index: [M] index of each texel: row times ``size`` plus column.
        face: [M] index of the triangle of each texel.
        weights: [M, 3] barycentric coordinates in the triangle, in single precision.
    """

    size: int
    index: NDArray[np.int64]
    face: NDArray[np.int64]
    weights: NDArray[np.float32]

    def interpolated(self, faces: NDArray[np.int64], values: NDArray[Any]) -> NDArray[np.float32]:
        """Interpolate values [V, C] from the vertices of ``faces`` to the texels, [M, C]."""
        out = np.zeros((len(self.index), values.shape[1]), np.float32)
        for corner in range(3):
            out += self.weights[:, corner, None] * values[faces[self.face, corner]].astype(np.float32)
        return out

    def texture(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Write values [M, C] into a texture [size, size, C]. Texels outside the charts take the nearest value."""
        picture = np.zeros((self.size * self.size, values.shape[1]), np.float32)
        empty = np.ones(self.size * self.size, bool)
        picture[self.index] = values
        empty[self.index] = False
        row, column = distance_transform_edt(
            empty.reshape(self.size, self.size), return_distances=False, return_indices=True
        )
        return np.asarray(picture.reshape(self.size, self.size, -1)[row, column])


def rasterized_texels(mesh: Unwrapped, size: int) -> Texels:
    """Rasterize the triangles of a mesh into its texture of ``size`` x ``size`` texels.

    Raises:
        PolarguideError: no texel lies on a triangle.
    """
    corners = mesh.uv[mesh.faces] * size - 0.5  # Integers are centers of texels.
    low = np.clip(np.ceil(corners.min(axis=1)), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1)), -1, size - 1).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    counts = extent.prod(axis=1)
    parts = []
    begin = 0
    ends = np.cumsum(counts)
    while begin < len(counts):
        reached = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, reached + _CANDIDATES, side="right")))
        parts.append(_inside(corners, low, extent, counts, np.arange(begin, end)))
        begin = end
    column, row, face, weights = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    index, first = np.unique(row * size + column, return_index=True)  # A texel on a common edge has one face.
    if not len(index):
        raise PolarguideError(
            "texture", expected="texels on the triangles", found="none", remedy="Choose a larger --texture."
        )
    return Texels(size, index, face[first], weights[first])


def _inside(
    corners: NDArray[np.float64],
    low: NDArray[np.int64],
    extent: NDArray[np.int64],
    counts: NDArray[np.int64],
    faces: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Return columns, rows, faces and barycentric coordinates of the texels inside a batch of triangles."""
    face = np.repeat(faces, counts[faces])
    number = np.arange(len(face)) - np.repeat(np.cumsum(counts[faces]) - counts[faces], counts[faces])
    column = low[face, 0] + number % np.maximum(extent[face, 0], 1)
    row = low[face, 1] + number // np.maximum(extent[face, 0], 1)
    a, b, c = (corners[face, k] for k in range(3))
    place = np.stack([column, row], axis=1)
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        second = _cross(place - a, c - a) / area
        third = _cross(b - a, place - a) / area
    weights = np.stack([1 - second - third, second, third], axis=1)
    inside = (weights >= -1e-9).all(axis=1)  # Triangles without area have NaN.
    return column[inside], row[inside], face[inside], weights[inside].astype(np.float32)


def _cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
