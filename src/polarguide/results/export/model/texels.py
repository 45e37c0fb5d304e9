"""Texels of an unwrapped mesh: their positions on the surface, and filled textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from polarguide.core.errors import PolarguideError
from polarguide.results.export.model.unwrap import Unwrapped

_CANDIDATES = 1 << 21  # pairs of triangle and texel per batch, about 200 MB


@dataclass(frozen=True, eq=False)
class Texels:
    """The M texels of a square texture whose centers lie on a triangle.

    Attributes:
        size: texels along the texture's side. index: [M] row times ``size`` plus column.
        face: [M] triangle of each texel. weights: [M, 3] barycentric coordinates, single precision.
    """

    size: int
    index: NDArray[np.int64]
    face: NDArray[np.int64]
    weights: NDArray[np.float32]

    def interpolated(self, faces: NDArray[np.int64], values: NDArray[Any]) -> NDArray[np.float32]:
        """Interpolate values [V, C] at the vertices of faces to the texels, [M, C]."""
        out = np.zeros((len(self.index), values.shape[1]), np.float32)
        for corner in range(3):
            out += self.weights[:, corner, None] * values[faces[self.face, corner]].astype(np.float32)
        return out

    def texture(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Return a texture [size, size, C] of values [M, C]. Texels outside the charts have the nearest value."""
        picture = np.zeros((self.size * self.size, values.shape[1]), np.float32)
        empty = np.ones(self.size * self.size, bool)
        picture[self.index] = values
        empty[self.index] = False
        row, column = distance_transform_edt(
            empty.reshape(self.size, self.size), return_distances=False, return_indices=True
        )
        return np.asarray(picture.reshape(self.size, self.size, -1)[row, column])


def rasterized_texels(mesh: Unwrapped, size: int) -> Texels:
    """Rasterize the triangles of a mesh in its texture of ``size`` x ``size`` texels.

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
    """Return columns, rows, faces and barycentric coordinates of the texels inside some of the triangles."""
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
