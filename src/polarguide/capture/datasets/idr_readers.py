"""PANDORA, NeRSP and their repacks: Stokes vectors with cameras of IDR, ``world_mat_<i>`` and ``scale_mat_<i>``."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.datasets.dataset import (
    Dataset,
    StokesImage,
    cameras_of_views,
    first_picture_size,
    masks_beside,
    missing_entry,
    not_as_published,
    numbered_views,
    pinhole_camera,
    read_mask,
    read_projections,
    require_same_shape,
    stokes_dataset,
)
from polarguide.capture.formats.arrays import BROKEN, array_kind, unpacked
from polarguide.capture.formats.integrity import LARGEST_PIXELS, damaged
from polarguide.capture.formats.pictures import SUFFIXES, decode_stored, read_picture, stated_size
from polarguide.capture.layout import index_files
from polarguide.capture.transforms_file import Size, is_centered
from polarguide.core.errors import PolarguideWarning
from polarguide.core.files import read_file

# Of the releases and of NeRSP's, PolGS's and PhyGaP's copies of them.
STOKES_FOLDERS = ("images_stokes", "train_images_stokes")
_PICTURES = ("image", "images", "train", "I-sum", "I_sum")
_MAPS = ("input_azimuth_maps", "train_input_azimuth_maps")
_PANDORA_PARTS = ("s0", "s0p1", "s0p2")
_PANDORA_STEM = re.compile(r"(?P<view>\d{1,6})_(?P<part>s0|s0p1|s0p2)")


def open_pandora(root: Path) -> Dataset:
    """Find the files of PANDORA, also as NeRSP and PolGS pack them, and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    folder = _folder(root, STOKES_FOLDERS)
    cameras_file = root / "cameras.npz"
    matches = [_PANDORA_STEM.fullmatch(stem) for stem in index_files(folder, (".hdr",))]
    views = sorted({match["view"] for match in matches if match is not None})
    files = {view: [folder / f"{view}_{part}.hdr" for part in _PANDORA_PARTS] for view in views}
    pictures = index_files(_folder(root, _PICTURES), SUFFIXES)
    # Files count from 1, unless a file or a picture is called 00.
    first = 0 if any(int(view) == 0 for view in views) or "00" in pictures else 1
    cameras: dict[str, PosedCamera] | None = None
    posed_by: Path | None = None
    notes: tuple[str, ...] = ()
    # PhyGaP's copy has a COLMAP model in place of the cameras.
    if cameras_file.exists() or not (root / "sparse").is_dir():
        offsets = (0,) if first == 0 else None
        light = files[views[0]][0] if views else None
        by_number = {view: int(view) for view in views}
        parts, numbers = _cameras(root, cameras_file, by_number, pictures, light, offsets)
        cameras = cameras_of_views(cameras_file, numbers, parts, "world_mat_")
        posed_by = cameras_file
        shift = next(iter(numbers.values())) - int(next(iter(numbers))) if numbers else 0
        notes = (f"Files count from {first}, cameras from {first + shift}.",)
    masks, read = _masks(root, {view: int(view) for view in views}, first)
    return stokes_dataset(
        "pandora", _PANDORA_PARTS, files, _stokes, posed_by, cameras, masks, read_mask=read, notes=notes
    )


def _stokes(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    total, plus1, plus2 = planes
    return np.asarray(np.stack([total, plus1 - total, plus2 - total]) / np.float32(2), np.float32)


_NERSP_PARTS = ("s0", "s1", "s2")
_NERSP_ENTRIES = ("S0", "S1", "S2")
_NERSP_CAMERAS = ("cameras.npz", "cameras_new.npz", "cameras_sphere.npz")


def open_nersp(root: Path) -> Dataset:
    """Find the files of NeRSP (SMVP3D, and RMVP3D with an archive a view), also as PolGS packs them, and the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    cameras_file = next(
        (root / name for name in _NERSP_CAMERAS if (root / name).exists()), root / _NERSP_CAMERAS[0]
    )
    archives = index_files(_folder(root, STOKES_FOLDERS), (".npz",))
    stems = set(archives) or {stem for part in _NERSP_PARTS for stem in index_files(root / part, (".npy",))}
    views = numbered_views(stems)
    pictures = index_files(_folder(root, _PICTURES), SUFFIXES)
    light = None if archives else next(iter(sorted((root / _NERSP_PARTS[0]).glob("*.npy"))), None)
    parts, numbers = _cameras(root, cameras_file, views, pictures, light, (0,))
    cameras = cameras_of_views(cameras_file, numbers, parts, "world_mat_")
    masks, read = _masks(root, views, 0)
    if archives:
        return _archived(archives, cameras_file, cameras, masks, read)
    files = {view: [root / part / f"{view}.npy" for part in _NERSP_PARTS] for view in views}
    return stokes_dataset(
        "nersp", _NERSP_PARTS, files, _halved, cameras_file, cameras, masks,
        read_mask=read, sense="cw", sense_known=False,
    )  # fmt: skip


def _halved(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    return planes / np.float32(2)


def _archived(
    archives: Mapping[str, Path],
    cameras_file: Path,
    cameras: Mapping[str, PosedCamera],
    masks: Mapping[str, Path],
    read: Callable[[Path], NDArray[np.bool_]],
) -> Dataset:
    """RMVP3D: an archive with S0, S1 and S2 for each view."""
    files = {view: archives[view] for view in cameras}

    def read_stokes(view: str) -> StokesImage:
        stokes = _halved(_read_archive(files[view]))
        return stokes, np.zeros(stokes.shape[1:3], bool)

    return Dataset(
        name="nersp",
        views=sorted(files),
        paths=[*files.values(), *masks.values(), cameras_file],
        files=files,
        cameras=cameras,
        read_stokes=read_stokes,
        masks=masks,
        read_mask=read,
        sense="cw",
        sense_known=False,
    )


def _read_archive(path: Path) -> NDArray[np.float32]:
    """Stokes vectors [3, H, W, 3] from the entries S0, S1 and S2 of an archive.

    Raises:
        PolarguideError: the file cannot be read, lacks an entry, or its entries are no pictures of one size.
    """
    data = read_file(path)
    try:
        arrays = unpacked(data, _NERSP_ENTRIES, 8 * 3 * LARGEST_PIXELS)
    except BROKEN as error:
        raise damaged(path, "a complete .npz file of numbers", f"a damaged one ({error})") from error
    for key in _NERSP_ENTRIES:
        if key not in arrays:
            raise missing_entry(path, key, arrays)
        plane = arrays[key]
        if plane.ndim != 3 or plane.shape[2] != 3 or plane.dtype.kind != "f":
            raise not_as_published(
                f"{path} ({key})", "floating-point numbers of three channels", array_kind(plane)
            )
        require_same_shape(path, plane.shape, arrays["S0"].shape, path)
    return np.stack([arrays[key] for key in _NERSP_ENTRIES]).astype(np.float32)


def _folder(root: Path, names: tuple[str, ...]) -> Path:
    """The first of the folders that there is."""
    return next((root / name for name in names if (root / name).is_dir()), root / names[0])


def _cameras(
    root: Path,
    path: Path,
    views: Mapping[str, int],
    pictures: Mapping[str, Path],
    light: Path | None,
    offsets: tuple[int, ...] | None,
) -> tuple[dict[int, PosedCamera], dict[str, int]]:
    """Cameras by their number, and the number of each view's camera.

    Cameras count from 0 (``world_mat_0``), or as the releases of PANDORA and PolGS's copies do, from 1
    (``world_mat_01``). No view ever gets the camera of another because one was removed: a way of counting is chosen by
    where the numbers of the cameras begin, and holds only if it gives every view a camera.

    Args:
        root, path: the dataset and the file of its cameras.
        views: view -> number of its files.
        pictures: what the intrinsics were made for.
        light: a file of Stokes vectors, whose size the cameras have if the pictures were resized later.
        offsets: of cameras' numbers from those of files that count from 0; None for files that count from 1.
    """
    projections = read_projections(path)
    known = projections.cameras
    size = first_picture_size(pictures, _folder(root, _PICTURES)) if views else (1, 1)
    size = _size_of(path, [inner for inner, *_ in known.values()], size, light) if views else size
    if offsets is None:
        offsets = (-1,) if 0 in known else (0, -1)
    elif projections.padded and 0 not in known and "00" not in pictures:
        offsets = (1, *offsets)
    chosen = next(
        (offset for offset in offsets if all(number + offset in known for number in views.values())),
        offsets[-1],
    )
    cameras = {number: pinhole_camera(size, *camera) for number, camera in known.items()}
    return cameras, {view: number + chosen for view, number in views.items()}


def _size_of(path: Path, inner: Sequence[NDArray[np.float64]], size: Size, light: Path | None) -> Size:
    """The size that cameras were made for: of the pictures, or of the Stokes vectors if those were resized later.

    Args:
        path: their file, for messages.
        inner: their intrinsics.
        size: size of the pictures. light: a file of Stokes vectors.
    """
    centers = [(float(matrix[0, 2]), float(matrix[1, 2])) for matrix in inner]
    other = None if light is None else stated_size(light)
    for candidate in (size, *([] if other is None else [other])):
        if all(is_centered(candidate, center) for center in centers):
            return candidate
    warnings.warn(
        f"{path.name}: principal points lie far from the middle of the pictures, {size[0]}x{size[1]}, as "
        "those of pictures that were cropped or resized do. The size is taken as it is.",
        PolarguideWarning,
        stacklevel=2,
    )
    return size


def _masks(
    root: Path, views: Mapping[str, int], first: int
) -> tuple[dict[str, Path], Callable[[Path], NDArray[np.bool_]]]:
    """Object masks by view and what reads them: ``mask/`` or ``masks/``, else the alpha of NeRSP's azimuth maps.

    Args:
        root: the dataset.
        views: view -> its number.
        first: the number that they count from; maps count from 0.
    """
    maps = index_files(_folder(root, _MAPS), (".png",))
    if not maps:
        return masks_beside(root, views), read_mask
    by_index = {int(stem): path for stem, path in maps.items() if stem.isascii() and stem.isdigit()}
    indices = {view: number - first for view, number in views.items()}
    return {view: by_index[index] for view, index in indices.items() if index in by_index}, _last_channel


def _last_channel(path: Path) -> NDArray[np.bool_]:
    """The mask that NeRSP's azimuth maps have in their last channel."""
    pixels = decode_stored(path, read_picture(path))
    return np.asarray((pixels if pixels.ndim == 2 else pixels[..., -1]) > 0)
