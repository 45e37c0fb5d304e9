"""Convert the camera files of published datasets to COLMAP's conventions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.datasets.dataset import not_as_published
from polarguide.capture.formats.arrays import finite_numbers, read_arrays, wrong_camera
from polarguide.errors import PolarguideError

_LARGEST_SKEW = 1e-3
_SQUARE = ((3, 4), (4, 4))
Matrix = NDArray[np.float64]


def read_projections(path: Path) -> dict[int, tuple[Matrix, Matrix, Matrix]]:
    """Cameras of a file with ``world_mat_<i>`` and ``scale_mat_<i>`` (IDR): P = world_mat @ scale_mat.

    The world of the result is the normalized one, in which the object lies in the unit sphere.

    Returns:
        Number -> K [3, 3] with K[2, 2] = 1, world-to-camera rotation [3, 3] and translation [3].

    Raises:
        PolarguideError: the file has no camera, or a matrix is not that of a camera.
    """
    arrays = read_arrays(path)
    found = {}
    for key in arrays:
        match = re.fullmatch(r"world_mat_(\d{1,6})", key)
        if match is None:
            continue
        number = int(match[1])
        scale_key = f"scale_mat_{match[1]}"
        if scale_key not in arrays:
            raise missing_entry(path, scale_key, arrays)
        world = finite_numbers(f"{path} ({key})", arrays[key], _SQUARE)
        scale = finite_numbers(f"{path} ({scale_key})", arrays[scale_key], ((4, 4),))
        found[number] = decompose_projection(f"{path} ({key} @ {scale_key})", (world @ scale)[:3])
    if not found:
        raise missing_entry(path, "world_mat_<i>", arrays)
    return found


def decompose_projection(where: object, projection: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """K, R and t of a 3x4 matrix s K [R | t] of any scale s.

    Raises:
        PolarguideError: it is singular, or its pixels are skewed.
    """
    left = projection[:, :3]
    if not np.linalg.cond(left) < 1e10:
        raise wrong_camera(where, "a camera matrix that can be inverted", "a singular one")
    if np.linalg.det(left) < 0:  # a matrix means the same with the other sign; rotations have determinant 1
        projection, left = -projection, -left
    inner, rotation = rq(left)
    signs = np.diag(np.sign(np.diag(inner)))
    inner, rotation = inner @ signs, signs @ rotation
    translation = np.linalg.solve(inner, projection[:, 3])
    return checked_intrinsics(where, inner / inner[2, 2]), rotation, translation


def checked_intrinsics(where: object, inner: Matrix) -> Matrix:
    """K, checked to be an intrinsic matrix without skew.

    Raises:
        PolarguideError: focal lengths are not positive, or the skew is not small.
    """
    lower = np.abs([inner[1, 0], inner[2, 0], inner[2, 1], inner[2, 2] - 1]).max()
    skew = abs(inner[0, 1]) / max(abs(inner[0, 0]), 1e-12)
    if not (inner[0, 0] > 0 and inner[1, 1] > 0 and lower < 1e-6 and skew < _LARGEST_SKEW):
        expected = "an intrinsic matrix with positive focal lengths and without skew"
        raise wrong_camera(where, expected, str(np.round(inner, 4).tolist()))
    return inner


def checked_pose(where: object, matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Rotation and translation of a rigid [3 or 4, 4] matrix; rounding errors of the rotation are removed.

    Raises:
        PolarguideError: it is not rigid.
    """
    u, spread, vt = np.linalg.svd(matrix[:3, :3])
    if not (np.abs(spread - 1) < 1e-2).all() or np.linalg.det(u @ vt) < 0:
        found = f"a matrix with singular values {np.round(spread, 4).tolist()} and determinant "
        found += f"{np.linalg.det(matrix[:3, :3]):.3g}"
        raise wrong_camera(where, "a rotation and a translation", found)
    return u @ vt, matrix[:3, 3]


def pinhole_camera(
    size: tuple[int, int], inner: Matrix, rotation: Matrix, translation: Matrix
) -> PosedCamera:
    """A camera without distortion; ``inner`` counts pixels as COLMAP does."""
    parameters = (inner[0, 0], inner[1, 1], inner[0, 2], inner[1, 2])
    return PosedCamera(*size, "PINHOLE", tuple(float(p) for p in parameters), rotation, translation)


def distorted_camera(
    where: object, size: tuple[int, int], inner: Matrix, coefficients: Any, pose: Sequence[Matrix]
) -> PosedCamera:
    """A camera calibrated with OpenCV, with 4, 5 or 8 distortion coefficients.

    OpenCV counts from the center of the top-left pixel, COLMAP from its corner: the principal point moves by half.

    Raises:
        PolarguideError: there are other coefficients.
    """
    flat = np.ravel(np.asarray(coefficients))
    k = finite_numbers(where, flat, ((4,), (5,), (8,)))
    padded = [*k, *[0.0] * (8 - len(k))]
    parameters = (inner[0, 0], inner[1, 1], inner[0, 2] + 0.5, inner[1, 2] + 0.5, *padded)
    rotation, translation = pose
    return PosedCamera(*size, "FULL_OPENCV", tuple(float(p) for p in parameters), rotation, translation)


def missing_entry(path: Path, key: str, found: Mapping[str, object]) -> PolarguideError:
    """The error that a file lacks an entry."""
    names = sorted(found)
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return not_as_published(path, f"the entry {key}", shown or "no entry")
