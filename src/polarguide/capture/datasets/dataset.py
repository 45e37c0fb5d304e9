"""The common interface of published datasets, and their cameras in COLMAP's conventions."""

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
from polarguide.capture.formats.arrays import (
    finite_numbers,
    read_arrays,
    read_radiance,
    require_camera,
    wrong_camera,
)
from polarguide.capture.formats.pictures import SUFFIXES, decode_mask, decode_stored, read_picture
from polarguide.capture.layout import index_files
from polarguide.core.errors import PolarguideError, PolarguideWarning, require
from polarguide.core.text import listed

StokesImage = tuple[NDArray[np.float32], NDArray[np.bool_]]
"""Stokes vectors of a view [3, H, W, 3] in the dataset's own sense of angles; pixels at full scale in its pictures."""


def read_mask(path: Path) -> NDArray[np.bool_]:
    """An object mask [H, W] from a picture: pixels of at least half its largest value.

    If the picture is transparent around the object, the mask has the pixels that are at least half opaque.
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
    """A folder of a published dataset.

    Attributes:
        name: "pandora", "pisr", ...
        views: view names, sorted.
        paths: all files that are read.
        files: view -> a file of it, whose header has the size of the view's picture.
        cameras: view -> camera; None where the folder has none of its own.
        read_stokes: reads the Stokes vectors of a view; None if ``mosaics`` holds raw files instead.
        masks: view -> file of its object mask, for the views that have one.
        read_mask: reads such a file, [H, W].
        sense: direction in which angles increase as displayed, "ccw" or "cw".
        sense_known: whether the release and the programs that read it agree on the sense.
        mosaics: folder of raw mosaics, or None.
        gamma: exponent of the mosaics' stored values: stored = linear ^ gamma.
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
    """Object masks by view: the pictures in ``mask/`` or ``masks/``, whichever there is, called like the views.

    Names may be numbers with more or fewer zeros before them, if every view has one. Views without a mask beside others
    with one are warned of.

    Args:
        root: the dataset.
        views: view -> its number.
    """
    pictures = index_files(root / "mask", SUFFIXES) or index_files(root / "masks", SUFFIXES)
    masks = {view: pictures[view] for view in views if view in pictures}
    by_number = {number: pictures[stem] for stem, number in numbered_views(set(pictures)).items()}
    if not masks and set(views.values()) <= by_number.keys():
        masks = {view: by_number[number] for view, number in views.items()}
    without = [view for view in views if view not in masks]
    if pictures and without:
        text = f"{next(iter(pictures.values())).parent} has no mask called like {len(without)} of {len(views)} views"
        warnings.warn(f"{text} ({listed(without)}).", PolarguideWarning, stacklevel=2)
    return masks


def not_as_published(where: object, expected: str, found: str) -> PolarguideError:
    """The error that a file of a dataset is not what its authors published."""
    return PolarguideError(
        where,
        expected=expected,
        found=found,
        remedy="Take the files from the dataset as they were published.",
    )


def require_published(condition: object, where: object, expected: str, found: str) -> None:
    """Check a condition on a file of a dataset.

    Raises:
        PolarguideError: the condition does not hold.
    """
    if not condition:
        raise not_as_published(where, expected, found)


def stokes_dataset(
    name: str,
    parts: Sequence[str],
    files: Mapping[str, Sequence[Path]],
    stokes: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    cameras_file: Path | None,
    cameras: Mapping[str, PosedCamera] | None,
    masks: Mapping[str, Path],
    *,
    read_mask: Callable[[Path], NDArray[np.bool_]] = read_mask,
    sense: Sense = "ccw",
    sense_known: bool = True,
    notes: tuple[str, ...] = (),
) -> Dataset:
    """A dataset whose Stokes vectors follow from three radiance files a view.

    Args:
        name, cameras, masks, read_mask, sense, sense_known, notes: as in ``Dataset``.
        parts: what the three files of a view are called in messages.
        files: view -> its three files.
        stokes: the Stokes vectors [3, H, W, 3], given the three pictures [3, H, W, 3].
        cameras_file: the file of the cameras, if there is one.

    Raises:
        PolarguideError: a file is missing.
    """
    for index, part in enumerate(parts):
        require_files({view: paths[index] for view, paths in files.items()}, part)

    def read_stokes(view: str) -> StokesImage:
        planes = [read_radiance(path) for path in files[view]]
        for path, plane in zip(files[view], planes, strict=True):
            require_same_shape(path, plane.shape, planes[0].shape, files[view][0])
        return stokes(np.stack(planes)), np.zeros(planes[0].shape[:2], bool)

    paths = [*(path for of_view in files.values() for path in of_view), *masks.values()]
    paths += [] if cameras_file is None else [cameras_file]
    first = {view: of_view[0] for view, of_view in files.items()}
    return Dataset(
        name,
        sorted(files),
        paths,
        first,
        cameras,
        read_stokes,
        masks,
        read_mask,
        sense,
        sense_known,
        notes=notes,
    )


def require_files(files: Mapping[str, Path], kind: str) -> None:
    """Check that files exist.

    Raises:
        PolarguideError: one is missing.
    """
    for view, path in files.items():
        require(
            path.is_file(),
            path,
            expected=f"the {kind} of view {view}",
            found="nothing",
            remedy="Add the file, or remove the others of the view.",
        )


def cameras_of_views(
    path: Path, numbers: Mapping[str, int], cameras: Mapping[int, PosedCamera], entry: str
) -> dict[str, PosedCamera]:
    """Cameras by view name.

    Args:
        path: the camera file, for messages.
        numbers: view -> number of its camera.
        cameras: by number.
        entry: name of an entry of the file, without its number.

    Raises:
        PolarguideError: a view has none.
    """
    without = [view for view, number in numbers.items() if number not in cameras]
    if without:
        number = numbers[without[0]]
        raise PolarguideError(
            path,
            expected=f"the entry {entry}{number} for view {without[0]}",
            found=f"none; {len(without)} of {len(numbers)} views have no camera ({listed(without)})",
            remedy="Take the file from the dataset as it was published.",
        )
    return {view: cameras[number] for view, number in numbers.items()}


def require_same_shape(path: Path, shape: tuple[int, ...], first: tuple[int, ...], like: Path) -> None:
    """Check that a file has the size of another one of its view.

    Raises:
        PolarguideError: the sizes differ.
    """
    expected = f"{first[1]}x{first[0]} pixels like {like.name}"
    require_published(shape[:2] == first[:2], path, expected, f"{shape[1]}x{shape[0]}")


def numbered_views(stems: set[str]) -> dict[str, int]:
    """View -> number, for the stems that are numbers."""
    return {stem: int(stem) for stem in sorted(stems) if stem.isascii() and stem.isdigit() and len(stem) < 7}


def first_picture_size(pictures: Mapping[str, Path], folder: Path) -> tuple[int, int]:
    """Width and height of the first picture, which the intrinsics belong to.

    Raises:
        PolarguideError: there is none, or it is damaged.
    """
    require_published(pictures, folder, "the pictures that the intrinsics belong to", "none")
    path = pictures[min(pictures)]
    height, width = decode_stored(path, read_picture(path)).shape[:2]
    return width, height


def resized_mask(dataset: Dataset, view: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    """The object mask of a view at a picture size (height, width), or None where it has none.

    A mask of another resolution is resized: where half of a pixel or more is object.

    Raises:
        PolarguideError: the mask has another aspect.
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
        f"the aspect of the pictures, {size[1]}x{size[0]}",
        f"{width}x{height}",
    )
    way = cv2.INTER_AREA if height > size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=way) >= 0.5)


_LARGEST_SKEW = 1e-3
# Of IDR and the files that it was made after.
_IDR_ENTRY = re.compile(r"((world|scale|camera)_mat_(inv_)?|pose_mat_)\d{1,6}")
_SQUARE = ((3, 4), (4, 4))
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Projections:
    """Cameras of IDR.

    Attributes:
        cameras: number -> K [3, 3] with K[2, 2] = 1, world-to-camera rotation [3, 3] and translation [3].
        padded: whether numbers below 10 have a leading zero, as names of pictures do.
    """

    cameras: dict[int, tuple[Matrix, Matrix, Matrix]]
    padded: bool


def read_projections(path: Path) -> Projections:
    """Cameras of a file with ``world_mat_<i>`` and ``scale_mat_<i>`` (IDR): P = world_mat @ scale_mat.

    The world of the result is the normalized one, in which the object lies in the unit sphere. The inverses that some
    files hold, too, say nothing else.

    Raises:
        PolarguideError: the file has no camera, a matrix is not that of a camera, two have one number, or they project
            to other units than pixels.
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
            "two, with and without zeros before it",
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
        world = finite_numbers(f"{path} ({key})", arrays[key], _SQUARE)
        scale = finite_numbers(f"{path} ({scale_key})", arrays[scale_key], ((4, 4),))
        if size := float(
            np.linalg.norm(scale[:3, :3], 2)
        ):  # of a rotation and one scale: nothing is stretched
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


def require_known_names(path: Path, strangers: Iterable[str]) -> None:
    """Warn of fields of a camera file that are not read, by name, if there are any."""
    names = sorted(strangers)
    if names:
        text = f"{path.name} has fields that polarguide does not know and does not use: {listed(names)}."
        warnings.warn(text, PolarguideWarning, stacklevel=2)


def decompose_projection(where: object, projection: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """K, R and t of a 3x4 matrix s K [R | t] of any scale s.

    Raises:
        PolarguideError: the matrix is singular, or its pixels are skewed.
    """
    left = projection[:, :3]
    require_camera(
        np.linalg.cond(left) < 1e10, where, "a camera matrix that can be inverted", "a singular one"
    )
    if np.linalg.det(left) < 0:  # a matrix means the same with the other sign; rotations have determinant 1
        projection = -projection
        left = -left
    inner, rotation = rq(left)
    signs = np.diag(np.sign(np.diag(inner)))
    inner = inner @ signs
    rotation = signs @ rotation
    translation = np.linalg.solve(inner, projection[:, 3])
    return checked_intrinsics(where, inner / inner[2, 2]), rotation, translation


def checked_intrinsics(where: object, inner: Matrix) -> Matrix:
    """K, checked to be an intrinsic matrix without skew.

    Raises:
        PolarguideError: focal lengths are not positive, or the skew is not small.
    """
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
    """Rotation and translation of a rigid [3 or 4, 4] matrix; rounding errors of the rotation are removed.

    Raises:
        PolarguideError: the matrix is not rigid.
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
    k = finite_numbers(where, np.ravel(np.asarray(coefficients)), ((4,), (5,), (8,)))
    padded = [*k, *[0.0] * (8 - len(k))]
    parameters = (inner[0, 0], inner[1, 1], inner[0, 2] + 0.5, inner[1, 2] + 0.5, *padded)
    rotation, translation = pose
    return PosedCamera(*size, "FULL_OPENCV", tuple(float(p) for p in parameters), rotation, translation)


def require_entries(path: Path, entries: Mapping[str, object], *keys: str) -> None:
    """Check that a file has entries.

    Raises:
        PolarguideError: one is missing.
    """
    for key in keys:
        require_published(key in entries, path, f"the entry {key}", listed(sorted(entries)) or "no entry")
