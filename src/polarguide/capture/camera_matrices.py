"""Cameras as matrices, in the convention of OpenCV, and the files of IDR with such cameras."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.formats.pictures import finite_numbers, read_arrays, require_camera, wrong_camera
from polarguide.core.errors import PolarguideWarning, require
from polarguide.core.text import listed

_LARGEST_SKEW = 1e-3
"""Largest skew in an intrinsic matrix that is ignored, relative to the focal length."""
# Names of the entries that IDR and related programs write.
_IDR_ENTRY = re.compile(r"((world|scale|camera)_mat_(inv_)?|pose_mat_)\d{1,6}")
POSE_SHAPES = ((3, 4), (4, 4))
"""Shapes of the matrix of a camera pose that are accepted in files."""
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Projections:
    """Cameras in a file of IDR.

    Attributes:
        cameras: three arrays of each camera by number: the intrinsic matrix K [3, 3] with K[2, 2] = 1, the rotation
            [3, 3], and the translation [3]. Rotation and translation lead from the world to the camera.
        padded: True if numbers below 10 have a leading zero in the file.
    """

    cameras: dict[int, tuple[Matrix, Matrix, Matrix]]
    padded: bool


def read_projections(path: Path) -> Projections:
    """Read the cameras of a file in IDR's format, with the arrays ``world_mat_<i>`` and ``scale_mat_<i>``.

    The projection of camera i is ``world_mat_<i> @ scale_mat_<i>``. In its world, the object is inside the unit sphere.
    The inverse matrices in the file are redundant and not read.

    Raises:
        PolarguideError: the file has no camera, a matrix is invalid, two cameras have one number, or the matrices
            do not project to pixels.
    """
    arrays = read_arrays(path)
    parts: dict[int, tuple[Matrix, Matrix, Matrix]] = {}
    padded = False
    for key in arrays:
        match = re.fullmatch(r"world_mat_(\d{1,6})", key)
        if match is None:
            continue
        number = int(match[1])
        require_camera(
            number not in parts,
            path,
            f"one camera of the number {number}",
            "two, with and without leading zeros",
        )
        padded |= match[1] != str(number)
        scale_key = f"scale_mat_{match[1]}"
        inner_key = f"camera_mat_{match[1]}"
        require_camera(
            inner_key not in arrays or _is_identity(arrays[inner_key]),
            path,
            "world_mat that projects to pixels",
            f"{inner_key}, which scales them to a picture from -1 to 1",
        )
        require_entries(path, arrays, scale_key)
        world = finite_numbers(f"{path} ({key})", arrays[key], POSE_SHAPES)
        scale = finite_numbers(f"{path} ({scale_key})", arrays[scale_key], ((4, 4),))
        size = float(np.linalg.norm(scale[:3, :3], 2))
        if size:  # the matrix must be a rotation with a uniform scale
            checked_pose(f"{path} ({scale_key})", scale[:3] / size)
        parts[number] = decompose_projection(f"{path} ({key} @ {scale_key})", (world @ scale)[:3])
    if not parts:
        require_entries(path, arrays, "world_mat_<i>")
    require_known_names(path, (key for key in arrays if _IDR_ENTRY.fullmatch(key) is None))
    return Projections(parts, padded)


def _is_identity(matrix: NDArray[Any]) -> bool:
    return (
        matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1] and np.allclose(matrix, np.eye(len(matrix)))
    )


def require_known_names(path: Path, unknown: Iterable[str]) -> None:
    """Log a warning if a camera file has unknown fields."""
    names = sorted(unknown)
    if names:
        warnings.warn(
            f"{path.name} has unknown fields, which are ignored: {listed(names)}.",
            PolarguideWarning,
            stacklevel=2,
        )


def decompose_projection(where: object, projection: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Decompose a 3x4 projection matrix ``s K [R | t]`` with an unknown scale s into K, R and t.

    Raises:
        PolarguideError: the matrix is singular, or its pixels are skewed.
    """
    left = projection[:, :3]
    require_camera(
        np.linalg.cond(left) < 1e10, where, "a camera matrix that can be inverted", "a singular one"
    )
    if np.linalg.det(left) < 0:  # the scale may be negative, and rotations have determinant 1
        projection = -projection
        left = -left
    inner, rotation = rq(left)
    signs = np.diag(np.sign(np.diag(inner)))
    inner = inner @ signs
    rotation = signs @ rotation
    return checked_intrinsics(where, inner / inner[2, 2]), rotation, np.linalg.solve(inner, projection[:, 3])


def checked_intrinsics(where: object, matrix: object) -> Matrix:
    """Check an intrinsic matrix of shape 3x3, 3x4 or 4x4, and return its 3x3 part.

    Raises:
        PolarguideError: the shape is invalid, focal lengths are not positive, or pixels are skewed.
    """
    inner = finite_numbers(where, matrix, ((3, 3), *POSE_SHAPES))[:3, :3]
    lower = np.abs([inner[1, 0], inner[2, 0], inner[2, 1], inner[2, 2] - 1]).max()
    skew = abs(inner[0, 1]) / max(abs(inner[0, 0]), 1e-12)
    require_camera(
        inner[0, 0] > 0 and inner[1, 1] > 0 and lower < 1e-6 and skew < _LARGEST_SKEW,
        where,
        "an intrinsic matrix with positive focal lengths and without skew",
        str(np.round(inner, 4).tolist()),
    )
    return inner


def checked_pose(where: object, matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Return the rotation and the translation of a 3x4 or 4x4 matrix.

    Rounding errors are removed, so the rotation is exactly orthogonal.

    Raises:
        PolarguideError: the matrix is not a rigid transformation.
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
    """Create a camera without distortion.

    Args:
        size: width and height.
        inner: intrinsic matrix in COLMAP's convention, in which pixel centers are at 0.5.
        rotation: rotation from the world to the camera, [3, 3].
        translation: translation from the world to the camera, [3].
    """
    parameters = (inner[0, 0], inner[1, 1], inner[0, 2], inner[1, 2])
    return PosedCamera(*size, "PINHOLE", tuple(float(p) for p in parameters), rotation, translation)


def require_entries(path: Path, entries: Mapping[str, object], *keys: str) -> None:
    """Check that a file of cameras has the entries.

    Raises:
        PolarguideError: an entry is missing.
    """
    for key in keys:
        require(
            key in entries,
            path,
            expected=f"the entry {key}",
            found=listed(sorted(entries)) or "no entry",
            remedy="Use the file as it was published or exported.",
        )
