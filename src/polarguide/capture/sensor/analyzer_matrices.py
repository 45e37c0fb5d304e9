"""Matrices that turn the samples of a cell into those of ideal polarizers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def correction_matrices(analyzers: list[Array], nominal: NDArray[Any]) -> Array:
    """Matrices from measured samples of a cell to those of ideal polarizers.

    ``C = W pinv(A) + n m^T``: A [4, 3] are the analyzer vectors, W those of ideal polarizers, n and m the unit vectors
    perpendicular to the columns of W and A. C A = W, and C is the identity where A is W.

    Args:
        analyzers: four of [..., 3], the vectors of the samples of a cell. nominal: their nominal angles in degrees.

    Returns:
        [4, 4, ...] float32.
    """
    u, v, w = ([a[..., component].astype(np.float32) for a in analyzers] for component in range(3))

    def dot(x: list[Any], y: list[Any]) -> Any:
        return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]

    uu, uv, uw, vv, vw, ww = dot(u, u), dot(u, v), dot(u, w), dot(v, v), dot(v, w), dot(w, w)
    # The inverse of A^T A by its adjugate: millions of 3x3 matrices, for which LAPACK's calls would take seconds.
    a00, a01, a02 = vv * ww - vw * vw, uw * vw - uv * ww, uv * vw - uw * vv
    a11, a12, a22 = uu * ww - uw * uw, uv * uw - uu * vw, uu * vv - uv * uv
    scale = 1 / (uu * a00 + uv * a01 + uw * a02)
    inverse = [
        [(r[0] * u[j] + r[1] * v[j] + r[2] * w[j]) * scale for j in range(4)]
        for r in ((a00, a01, a02), (a01, a11, a12), (a02, a12, a22))
    ]
    left = []
    for j in range(4):
        i, k, m = (other for other in range(4) if other != j)
        minor = u[i] * (v[k] * w[m] - v[m] * w[k]) - v[i] * (u[k] * w[m] - u[m] * w[k])
        minor = minor + w[i] * (u[k] * v[m] - u[m] * v[k])
        left.append(minor if j % 2 == 0 else -minor)
    rest = [0.5 if int(angle) % 90 == 0 else -0.5 for angle in nominal]
    along = dot(rest, left)
    length = np.copysign(np.sqrt(dot(left, left)), along)
    left = [part / length for part in left]
    cosine = [{0: 1.0, 90: -1.0}.get(int(angle), 0.0) for angle in nominal]
    sine = [{45: 1.0, 135: -1.0}.get(int(angle), 0.0) for angle in nominal]
    rows = []
    for k in range(4):
        turned = inverse[1] if cosine[k] else inverse[2]
        sign = cosine[k] + sine[k]
        rows.append([(inverse[0][j] + sign * turned[j]) / 2 + rest[k] * left[j] for j in range(4)])
    return np.asarray(rows, np.float32)
