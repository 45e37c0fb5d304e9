"""The common interface of published datasets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Sense
from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_mask, decode_stored
from polarguide.capture.formats.radiance import read_radiance
from polarguide.capture.layout import index_files
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError

StokesImage = tuple[NDArray[np.float32], NDArray[np.bool_]]
"""Stokes vectors of a view [3, H, W, 3] in the dataset's own sense of angles; pixels at full scale in its pictures."""


def read_mask(path: Path) -> NDArray[np.bool_]:
    """An object mask [H, W] from a picture: where it reaches half of its maximum."""
    return decode_mask(path, read_picture(path), any_value=False)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A folder of a published dataset.

    Attributes:
        name: "pandora", "pisr", ...
        views: view names, sorted.
        paths: all files that are read.
        cameras: view -> camera.
        read_stokes: reads the Stokes vectors of a view; None if ``mosaics`` holds raw files instead.
        masks: view -> file of its object mask, for the views that have one.
        read_mask: reads such a file, [H, W].
        sense: direction in which angles increase as displayed, "ccw" or "cw".
        mosaics: folder of raw mosaics, or None.
        gamma: exponent of the mosaics' stored values: stored = linear ^ gamma.
        notes: messages for the user.
    """

    name: str
    views: list[str]
    paths: list[Path]
    cameras: Mapping[str, PosedCamera]
    read_stokes: Callable[[str], StokesImage] | None
    masks: Mapping[str, Path]
    read_mask: Callable[[Path], NDArray[np.bool_]] = read_mask
    sense: Sense = "ccw"
    mosaics: Path | None = None
    gamma: float = 1.0
    notes: tuple[str, ...] = ()


def masks_beside(root: Path) -> dict[str, Path]:
    """Object masks by view: the pictures in ``mask/`` or ``masks/``, whichever there is."""
    return index_files(root / "mask", SUFFIXES) or index_files(root / "masks", SUFFIXES)


def not_as_published(where: object, expected: str, found: str) -> PolarguideError:
    """The error that a file of a dataset is not what its authors published."""
    remedy = "Take the files from the dataset as they were published."
    return PolarguideError(where, expected=expected, found=found, remedy=remedy)


def stokes_dataset(
    name: str,
    parts: Sequence[str],
    files: Mapping[str, Sequence[Path]],
    stokes: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    cameras_file: Path,
    cameras: Mapping[str, PosedCamera],
    masks: Mapping[str, Path],
    *,
    read_mask: Callable[[Path], NDArray[np.bool_]] = read_mask,
    sense: Sense = "ccw",
    notes: tuple[str, ...] = (),
) -> Dataset:
    """A dataset whose Stokes vectors follow from three radiance files a view.

    Args:
        name, cameras, masks, read_mask, sense, notes: as in ``Dataset``.
        parts: what the three files of a view are called in messages.
        files: view -> its three files.
        stokes: the Stokes vectors [3, H, W, 3], given the three pictures [3, H, W, 3].
        cameras_file: the file of the cameras.

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

    paths = [*(path for paths in files.values() for path in paths), *masks.values(), cameras_file]
    return Dataset(name, sorted(files), paths, cameras, read_stokes, masks, read_mask, sense, notes=notes)


def require_files(files: Mapping[str, Path], kind: str) -> None:
    """Check that files exist.

    Raises:
        PolarguideError: one is missing.
    """
    for view, path in files.items():
        if not path.is_file():
            raise PolarguideError(
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
            remedy="Take the file from the dataset as it was published, or remove the pictures of the view.",
        )
    return {view: cameras[number] for view, number in numbers.items()}


def require_same_shape(path: Path, found: tuple[int, ...], first: tuple[int, ...], like: Path) -> None:
    """Check that a file has the size of another one of its view.

    Raises:
        PolarguideError: the sizes differ.
    """
    if found[:2] != first[:2]:
        expected = f"{first[1]}x{first[0]} pixels like {like.name}"
        raise not_as_published(path, expected, f"{found[1]}x{found[0]}")


def numbered_views(stems: set[str]) -> dict[str, int]:
    """View -> number, for the stems that are numbers."""
    return {stem: int(stem) for stem in sorted(stems) if stem.isascii() and stem.isdigit() and len(stem) < 7}


def first_picture_size(pictures: Mapping[str, Path], folder: Path) -> tuple[int, int]:
    """Width and height of the first picture, which the intrinsics belong to.

    Raises:
        PolarguideError: there is none, or it is damaged.
    """
    if not pictures:
        raise not_as_published(folder, "the pictures that the intrinsics belong to", "none")
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
    if abs(height * size[1] - width * size[0]) > max(height, width):
        expected = f"the aspect of the pictures, {size[1]}x{size[0]}"
        raise not_as_published(f"mask of view {view}", expected, f"{width}x{height}")
    way = cv2.INTER_AREA if height > size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=way) >= 0.5)
