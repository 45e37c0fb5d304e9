"""Common interface of published datasets, and functions for their readers. Cameras follow COLMAP's conventions."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Sense
from polarguide.capture.camera_matrices import Matrix
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.formats.pictures import finite_numbers, read_mask, read_radiance
from polarguide.capture.formats.stored import SUFFIXES, decode_stored, read_picture
from polarguide.capture.layout import index_files, numbered_views
from polarguide.core.errors import PolarguideError, PolarguideWarning, require
from polarguide.core.text import listed

StokesImage = tuple[NDArray[np.float32], NDArray[np.bool_]]
"""Stokes vectors [3, H, W, 3] and a mask of the clipped pixels [H, W].

The angles of the Stokes vectors increase in the direction that the dataset uses, see ``Dataset.sense``.
"""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views, cameras and masks of a published dataset, and functions that read its pictures.

    Attributes:
        name: name of the dataset, a key of ``READERS``.
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
