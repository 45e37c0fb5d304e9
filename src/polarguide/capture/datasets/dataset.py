"""Common interface of published datasets, and functions for their readers. Cameras follow COLMAP's conventions."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from polarguide.capture.calibration import Sense
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.formats.pictures import (
    decode_mask,
    finite_numbers,
    read_arrays,
    read_radiance,
    require_camera,
    wrong_camera,
)
from polarguide.capture.formats.stored import SUFFIXES, decode_stored, read_picture
from polarguide.capture.layout import index_files
from polarguide.core.errors import PolarguideError, PolarguideWarning, require
from polarguide.core.text import listed

StokesImage = tuple[NDArray[np.float32], NDArray[np.bool_]]
"""Stokes vectors [3, H, W, 3] and a mask of the clipped pixels [H, W].

The angles of the Stokes vectors increase in the direction that the dataset uses, see ``Dataset.sense``.
"""


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a foreground mask [H, W] from a picture.

    A pixel is foreground if its value is at least half of the largest value. In a picture with transparent pixels, a
    pixel is foreground if it is at least half opaque.
    """
    data = read_picture(path)
    pixels = decode_stored(path, data)
    if pixels.ndim == 3 and pixels.shape[2] in (2, 4) and pixels.dtype.kind == "u":
        alpha = pixels[..., -1]
        full = int(np.iinfo(pixels.dtype).max)
        if (alpha < full).any():
            return np.asarray(2 * alpha.astype(np.int64) >= full)
    return decode_mask(path, data, any_value=False)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views, cameras and masks of a published dataset, and functions that read its pictures.

    Attributes:
        name: name of the dataset, a key of ``DATASETS``.
        views: names of the views, sorted.
        paths: paths of all files that are read.
        files: one file of each view. Its header states the size of the view's pictures.
        cameras: camera of each view; None if the folder has no cameras.
        read_stokes: function that reads the Stokes vectors of a view; None for a dataset of raw mosaics.
        masks: file of the foreground mask by view; some views may have no mask.
        read_mask: function that reads a file in ``masks`` as a mask [H, W].
        sense: direction in which the angles increase as displayed, "ccw" or "cw".
        sense_known: True if the publication of the dataset and the programs that read it agree on the sense.
        mosaics: folder of the raw mosaics, or None for a dataset of Stokes vectors.
        gamma: exponent of the values in raw mosaics: stored = linear ^ gamma.
        notes: messages for the user.
    """

    name: str
    views: list[str]
    paths: list[Path]
    files: Mapping[str, Path]
    cameras: Mapping[str, PosedCamera] | None
    read_stokes: Callable[[str], StokesImage] | None
    masks: Mapping[str, Path]
    read_mask: Callable[[Path], NDArray[np.bool_]] = read_mask
    sense: Sense = "ccw"
    sense_known: bool = True
    mosaics: Path | None = None
    gamma: float = 1.0
    notes: tuple[str, ...] = ()


def masks_beside(root: Path, views: Mapping[str, int]) -> dict[str, Path]:
    """Find the foreground masks in ``mask/`` or ``masks/``, and return them by view.

    A mask has the name of its view. Numbers may have a different number of leading zeros, such as ``7.png`` for the
    view 007, if every view has a mask. The user gets a warning if only some of the views have a mask.

    Args:
        root: folder of the dataset.
        views: number of each view by name.
    """
    pictures = index_files(root / "mask", SUFFIXES) or index_files(root / "masks", SUFFIXES)
    masks = {view: pictures[view] for view in views if view in pictures}
    by_number = {number: pictures[stem] for stem, number in numbered_views(set(pictures)).items()}
    if not masks and set(views.values()) <= by_number.keys():
        masks = {view: by_number[number] for view, number in views.items()}
    without = [view for view in views if view not in masks]
    if pictures and without:
        text = f"{next(iter(pictures.values())).parent} has no mask for {len(without)} of {len(views)} views"
        warnings.warn(f"{text} ({listed(without)}).", PolarguideWarning, stacklevel=2)
    return masks


def not_as_published(where: object, expected: str, found: str) -> PolarguideError:
    """Return the error for a file that differs from the published dataset."""
    return PolarguideError(
        where, expected=expected, found=found, remedy="Use the files of the dataset as they were published."
    )


def require_published(condition: object, where: object, expected: str, found: str) -> None:
    """Raise an error if a file of a dataset does not meet a condition.

    Raises:
        PolarguideError: the condition is false.
    """
    if not condition:
        raise not_as_published(where, expected, found)


def _read_planes(paths: Sequence[Path]) -> NDArray[np.float32]:
    """Read linear pictures that have the same size, [N, H, W, 3]."""
    planes = [read_radiance(path) for path in paths]
    for path, plane in zip(paths, planes, strict=True):
        require_same_shape(path, plane.shape, planes[0].shape, paths[0])
    return np.stack(planes)


def stokes_dataset(
    name: str,
    parts: Sequence[str],
    files: Mapping[str, Sequence[Path]],
    cameras_file: Path | None,
    cameras: Mapping[str, PosedCamera] | None,
    masks: Mapping[str, Path],
    *,
    read: Callable[[Sequence[Path]], NDArray[np.float32]] = _read_planes,
    stokes: Callable[[NDArray[np.float32]], NDArray[np.float32]] = np.asarray,
    read_mask: Callable[[Path], NDArray[np.bool_]] = read_mask,
    sense: Sense = "ccw",
    sense_known: bool = True,
    notes: tuple[str, ...] = (),
) -> Dataset:
    """Create a dataset that stores the Stokes vectors of a view in several files.

    Args:
        name: see ``Dataset``.
        parts: names of the files of a view for messages.
        files: files of each view, one for each part.
        cameras_file: file of the cameras, or None.
        cameras: see ``Dataset``.
        masks: see ``Dataset``.
        read: function that reads the files of a view as three pictures [3, H, W, 3]. By default, each file is a linear
            picture.
        stokes: function that converts the three pictures to Stokes vectors [3, H, W, 3]. By default, the pictures are
            the Stokes components.
        read_mask: see ``Dataset``.
        sense: see ``Dataset``.
        sense_known: see ``Dataset``.
        notes: see ``Dataset``.

    Raises:
        PolarguideError: a file is missing.
    """
    for index, part in enumerate(parts):
        require_files({view: paths[index] for view, paths in files.items()}, part)

    def read_stokes(view: str) -> StokesImage:
        planes = read(files[view])
        return stokes(planes), np.zeros(planes.shape[1:3], bool)

    return Dataset(
        name=name,
        views=sorted(files),
        paths=[
            *(path for paths in files.values() for path in paths),
            *masks.values(),
            *([] if cameras_file is None else [cameras_file]),
        ],
        files={view: paths[0] for view, paths in files.items()},
        cameras=cameras,
        read_stokes=read_stokes,
        masks=masks,
        read_mask=read_mask,
        sense=sense,
        sense_known=sense_known,
        notes=notes,
    )


def require_files(files: Mapping[str, Path], kind: str) -> None:
    """Check that files exist.

    Raises:
        PolarguideError: a file is missing.
    """
    for view, path in files.items():
        require(
            path.is_file(),
            path,
            expected=f"the {kind} of view {view}",
            found="nothing",
            remedy="Add the file, or remove the other files of the view.",
        )


def cameras_of_views(
    path: Path, numbers: Mapping[str, int], cameras: Mapping[int, PosedCamera], entry: str
) -> dict[str, PosedCamera]:
    """Return the camera of each view by name.

    Args:
        path: file of the cameras for messages.
        numbers: number of the camera by view name.
        cameras: cameras by number.
        entry: name of an entry of the file without the number, for messages.

    Raises:
        PolarguideError: a view has no camera.
    """
    without = [view for view, number in numbers.items() if number not in cameras]
    if without:
        raise not_as_published(
            path,
            f"the entry {entry}{numbers[without[0]]} for view {without[0]}",
            f"none; {len(without)} of {len(numbers)} views have no camera ({listed(without)})",
        )
    return {view: cameras[number] for view, number in numbers.items()}


def require_same_shape(path: Path, shape: tuple[int, ...], first: tuple[int, ...], like: Path) -> None:
    """Check that a file has the size of another file of its view.

    Raises:
        PolarguideError: the sizes differ.
    """
    expected = f"{first[1]}x{first[0]} pixels like {like.name}"
    require_published(shape[:2] == first[:2], path, expected, f"{shape[1]}x{shape[0]}")


def numbered_views(stems: set[str]) -> dict[str, int]:
    """Return the number of each view by name, for the names that are numbers."""
    return {stem: int(stem) for stem in sorted(stems) if stem.isascii() and stem.isdigit() and len(stem) < 7}


def first_picture_size(pictures: Mapping[str, Path], folder: Path) -> tuple[int, int]:
    """Return the width and height of the first picture. The intrinsics of the cameras refer to this size.

    Raises:
        PolarguideError: there are no pictures, or the first one is damaged.
    """
    require_published(pictures, folder, "the pictures of the intrinsics", "none")
    path = pictures[min(pictures)]
    height, width = decode_stored(path, read_picture(path)).shape[:2]
    return width, height


def resized_mask(dataset: Dataset, view: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return the foreground mask of a view, resized to a height and width. Return None if the view has no mask.

    A pixel of the result is foreground if at least half of its area is foreground in the file.

    Raises:
        PolarguideError: the mask has another aspect ratio.
    """
    if view not in dataset.masks:
        return None
    mask = dataset.read_mask(dataset.masks[view])
    if mask.shape == size:
        return mask
    height, width = mask.shape
    require_published(
        abs(height * size[1] - width * size[0]) <= max(height, width),
        f"mask of view {view}",
        f"the aspect ratio of the pictures, {size[1]}x{size[0]}",
        f"{width}x{height}",
    )
    way = cv2.INTER_AREA if height > size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=way) >= 0.5)


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


def distorted_camera(
    where: object, size: tuple[int, int], inner: Matrix, coefficients: Any, pose: Sequence[Matrix]
) -> PosedCamera:
    """Create a camera from a calibration by OpenCV with 4, 5 or 8 distortion coefficients.

    The origin of pixel coordinates is the center of the top-left pixel in OpenCV, and its corner in COLMAP. The
    principal point is therefore moved by half a pixel.

    Raises:
        PolarguideError: the number of coefficients is not 4, 5 or 8.
    """
    k = finite_numbers(where, np.ravel(np.asarray(coefficients)), ((4,), (5,), (8,)))
    parameters = (
        inner[0, 0],
        inner[1, 1],
        inner[0, 2] + 0.5,
        inner[1, 2] + 0.5,
        *[*k, *[0.0] * (8 - len(k))],
    )
    rotation, translation = pose
    return PosedCamera(*size, "FULL_OPENCV", tuple(float(p) for p in parameters), rotation, translation)


def require_entries(path: Path, entries: Mapping[str, object], *keys: str) -> None:
    """Check that a file has at least one entry.

    Raises:
        PolarguideError: the file has no entry.
    """
    for key in keys:
        require_published(key in entries, path, f"the entry {key}", listed(sorted(entries)) or "no entry")
