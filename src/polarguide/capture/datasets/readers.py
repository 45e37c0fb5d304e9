"""PANDORA, NeRSP and their repacks: Stokes vectors with cameras of IDR, ``world_mat_<i>`` and ``scale_mat_<i>``."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.datasets.dataset import (
    Dataset,
    StokesImage,
    cameras_of_views,
    checked_intrinsics,
    checked_pose,
    distorted_camera,
    first_picture_size,
    masks_beside,
    not_as_published,
    numbered_views,
    pinhole_camera,
    read_mask,
    read_projections,
    require_entries,
    require_files,
    require_known_names,
    require_published,
    require_same_shape,
    stokes_dataset,
)
from polarguide.capture.formats.arrays import (
    array_kind,
    array_size,
    decode_arrays,
    finite_numbers,
    read_array,
    read_arrays,
    read_exr_channels,
)
from polarguide.capture.formats.headers import LARGEST_PIXELS
from polarguide.capture.formats.pictures import (
    SUFFIXES,
    decode_picture,
    decode_stored,
    linear_codes,
    read_picture,
    stated_size,
)
from polarguide.capture.layout import index_files
from polarguide.capture.pose_files import Size, is_centered
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideWarning
from polarguide.core.files import read_file
from polarguide.core.records import read_record

# Names in the releases, and in the copies of NeRSP, PolGS and PhyGaP.
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
    arrays = decode_arrays(path, read_file(path), _NERSP_ENTRIES, 3 * 8 * 3 * LARGEST_PIXELS, kinds="biufcSU")
    require_entries(path, arrays, *_NERSP_ENTRIES)
    for key in _NERSP_ENTRIES:
        plane = arrays[key]
        require_published(
            plane.ndim == 3 and plane.shape[2] == 3 and plane.dtype.kind == "f",
            f"{path} ({key})",
            "floating-point numbers of three channels",
            array_kind(plane),
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


_NEISF_PARTS = ("images_s0", "images_s1", "images_s2")
_NEISF_STEM = re.compile(r"img_(\d{1,6})")


def open_neisf(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    matches = [
        _NEISF_STEM.fullmatch(stem) for part in _NEISF_PARTS for stem in index_files(root / part, (".exr",))
    ]
    numbers = {match[0]: int(match[1]) for match in matches if match is not None}
    files = {view: [root / part / f"{view}.exr" for part in _NEISF_PARTS] for view in numbers}
    cameras_file = root / "poses_bounds.npy"
    cameras = cameras_of_views(cameras_file, numbers, _llff_cameras(cameras_file), "row ")
    masks = masks_beside(root, numbers)
    return stokes_dataset(
        "neisf", _NEISF_PARTS, files, lambda planes: planes, cameras_file, cameras, masks, sense_known=False
    )


def _llff_cameras(path: Path) -> dict[int, PosedCamera]:
    """Row -> camera; rows count from 1 like the files."""
    rows = read_array(path)
    require_published(
        rows.ndim == 2 and rows.shape[1] == 17 and len(rows),
        path,
        "an array N x 17 of poses and bounds (LLFF)",
        array_size(rows),
    )
    cameras = {}
    for index, row in enumerate(rows):
        where = f"{path} (row {index})"
        down, right, back, center, inner = finite_numbers(where, row[:15], ((15,),)).reshape(3, 5).T
        height, width, focal = inner
        require_published(
            1 <= height <= 1e5 and 1 <= width <= 1e5 and focal > 0,
            where,
            "height, width and focal length in pixels",
            f"{height:g}, {width:g} and {focal:g}",
        )
        # OpenCV's axes: right, down, forward.
        axes = np.column_stack([np.stack([right, down, -back]), np.zeros(3)])
        rotation, _ = checked_pose(where, axes)
        middle = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        size = round(width), round(height)
        cameras[index + 1] = pinhole_camera(size, middle, rotation, -rotation @ center)
    return cameras


_SHAPES = ((3, 4), (4, 4))


def open_gnerp(root: Path, *, transfer: str) -> Dataset:
    """Find the files and read the cameras.

    Args:
        root: the folder.
        transfer: how the pictures are encoded: "linear", "srgb", or "auto", which takes "srgb".

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    transfer = "srgb" if transfer == "auto" else transfer
    pictures = index_files(root / "images", SUFFIXES)
    numbers = numbered_views(set(pictures))
    angles, degrees = ({view: root / part / f"{view}.npy" for view in numbers} for part in ("aop", "dop"))
    require_files(angles, "AoP")
    require_files(degrees, "DoP")
    masks = masks_beside(root, numbers)
    cameras_file = root / "cameras.json"
    size = (
        first_picture_size({view: pictures[view] for view in numbers}, root / "images") if numbers else (1, 1)
    )

    def read_stokes(view: str) -> StokesImage:
        stored = decode_picture(pictures[view], read_picture(pictures[view]))
        aop, dop = (_plane(files[view], stored.shape, pictures[view]) for files in (angles, degrees))
        if (largest := float(np.nanmax(np.abs(aop)))) > 2 * math.pi:
            raise not_as_published(angles[view], "angles in radians", f"up to {largest:g}")
        if (middle := float(np.nanmedian(dop))) > 1:
            raise not_as_published(degrees[view], "degrees from 0 to 1", f"a median of {middle:g}")
        s0 = 2 * linear_codes(stored, transfer).astype(np.float32) / np.float32(FULL_CODE)
        stokes = [s0, s0 * (dop * np.cos(2 * aop))[..., None], s0 * (dop * np.sin(2 * aop))[..., None]]
        return np.stack(stokes), np.asarray((stored == np.iinfo(stored.dtype).max).any(axis=2))

    used = [files[view] for view in numbers for files in (pictures, angles, degrees)]
    return Dataset(
        name="gnerp",
        views=sorted(numbers),
        paths=[*used, *masks.values(), cameras_file],
        files={view: pictures[view] for view in numbers},
        cameras=cameras_of_views(cameras_file, numbers, _gnerp_cameras(cameras_file, size), "w2c_mat_"),
        read_stokes=read_stokes,
        masks=masks,
        notes=(
            "AoP and DoP have one channel and are shared by R, G and B.",
            f"The pictures were taken as {transfer}"
            + (" and made linear before Stokes vectors were formed (--transfer says otherwise)."
               if transfer == "srgb" else "."),
        ),
    )  # fmt: skip


def _plane(path: Path, shape: tuple[int, ...], like: Path) -> NDArray[np.float32]:
    """Numbers [H, W] from a file with [H, W] or [H, W, 1]."""
    plane = read_array(path)
    if plane.ndim == 3 and plane.shape[2] == 1:
        plane = plane[..., 0]
    require_published(
        plane.ndim == 2 and plane.dtype.kind == "f",
        path,
        "floating-point numbers of one channel",
        array_kind(plane),
    )
    require_same_shape(path, plane.shape, shape, like)
    return np.asarray(plane, np.float32)


_GNERP_ENTRY = re.compile(r"w2c_mat_\d{1,6}|intrinsic(_\d{1,6})?")


def _gnerp_cameras(path: Path, size: tuple[int, int]) -> dict[int, PosedCamera]:
    """Number -> camera, from ``w2c_mat_<i>`` and ``intrinsic``, or ``intrinsic_<i>`` where there is one."""
    content: dict[str, Any] = read_record(path, dict[str, Any])
    cameras = {}
    for key, value in content.items():
        match = re.fullmatch(r"w2c_mat_(\d{1,6})", key)
        if match is None:
            continue
        inner_key = f"intrinsic_{match[1]}" if f"intrinsic_{match[1]}" in content else "intrinsic"
        require_entries(path, content, inner_key)
        where = f"{path} ({inner_key})"
        inner = finite_numbers(where, content[inner_key], ((3, 3), *_SHAPES))[:3, :3]
        pose = checked_pose(f"{path} ({key})", finite_numbers(f"{path} ({key})", value, _SHAPES))
        cameras[int(match[1])] = pinhole_camera(size, checked_intrinsics(where, inner), *pose)
    if not cameras:
        require_entries(path, content, "w2c_mat_<i>")
    require_known_names(path, (key for key in content if _GNERP_ENTRY.fullmatch(key) is None))
    return cameras


PHYGAP_CAMERAS = "camera_params.npz"
# The angle of view says again what the intrinsics and the size say.
_PHYGAP_ENTRIES = {"intrinsics", "extrinsics", "image_width", "image_height", "fov"}
_CHANNELS = tuple(tuple(f"S{part}.{color}" for color in "RGB") for part in range(3))


def open_phygap(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    folder = next(
        (root / name for name in ("images_full", "images") if (root / name).is_dir()), root / "images_full"
    )
    files = index_files(folder, (".exr",))
    numbers = numbered_views(set(files))
    path = root / PHYGAP_CAMERAS
    arrays = read_arrays(path)
    require_entries(path, arrays, "intrinsics", "extrinsics", "image_width", "image_height")
    require_known_names(path, arrays.keys() - _PHYGAP_ENTRIES)
    inner = checked_intrinsics(f"{path} (intrinsics)", finite_numbers(path, arrays["intrinsics"], ((3, 3),)))
    poses = arrays["extrinsics"]
    require_published(
        poses.ndim == 3 and poses.shape[1:] in _SHAPES,
        f"{path} (extrinsics)",
        "matrices N x 4 x 4",
        array_size(poses),
    )
    sides = [finite_numbers(f"{path} ({key})", arrays[key], ((),)) for key in ("image_width", "image_height")]
    require_published(
        all(1 <= side <= 1e5 for side in sides),
        f"{path} (image_width, image_height)",
        "a size in pixels",
        " and ".join(f"{float(side):g}" for side in sides),
    )
    size = (int(sides[0]), int(sides[1]))
    cameras = {}
    for number, pose in enumerate(poses):
        where = f"{path} (extrinsics {number})"
        rigid = checked_pose(where, finite_numbers(where, pose, ((3, 4), (4, 4))))
        cameras[number] = pinhole_camera(size, inner, *rigid)

    def read_stokes(view: str) -> StokesImage:
        s0, s1, s2 = read_exr_channels(files[view], _CHANNELS)
        stokes: Any = np.stack([s0, -s1, -s2])
        return stokes, np.zeros(s0.shape[:2], bool)

    masks = masks_beside(root, numbers)
    return Dataset(
        name="phygap",
        views=sorted(numbers),
        paths=[*(files[view] for view in numbers), *masks.values(), path],
        files={view: files[view] for view in numbers},
        cameras=cameras_of_views(path, numbers, cameras, "extrinsics "),
        read_stokes=read_stokes,
        masks=masks,
        notes=("Angles of Mitsuba count from the vertical of the picture: turned by 90 degrees.",),
    )


PISR_SENSOR: Final = "IMX250MYR"
# Size that ``camera_matrix`` was made for.
_PISR_SIZE = (1224, 1024)
# Poses of the calibration target and its error, which OpenCV returns with them, are of no picture here.
_PISR_ENTRIES = {"camera_matrix", "dist_coeffs", "rvecs", "tvecs", "ret", "rms"}
_PISR_CAMERAS = ("cameras_sphere.npz", "cameras.npz")


def open_pisr(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    files = index_files(root / "raw", (".npy",))
    numbers = numbered_views(set(files))
    cameras_file = next(
        (root / name for name in _PISR_CAMERAS if (root / name).exists()), root / _PISR_CAMERAS[0]
    )
    inner_file = root / "intrinsics.npz"
    intrinsics = read_arrays(inner_file)
    require_entries(inner_file, intrinsics, "camera_matrix", "dist_coeffs")
    require_known_names(inner_file, intrinsics.keys() - _PISR_ENTRIES)
    where = f"{inner_file} (camera_matrix)"
    inner = checked_intrinsics(where, finite_numbers(where, intrinsics["camera_matrix"], ((3, 3),)))
    coefficients = intrinsics["dist_coeffs"]
    cameras = {
        number: distorted_camera(f"{inner_file} (dist_coeffs)", _PISR_SIZE, inner, coefficients, pose)
        for number, (_, *pose) in read_projections(cameras_file).cameras.items()
    }
    masks = masks_beside(root, numbers)
    gamma = _gamma(root)
    note = f"Stored values are the light to the power of {gamma:g} (gamma file): undone."
    return Dataset(
        name="pisr",
        views=sorted(numbers),
        paths=[*files.values(), *masks.values(), inner_file, cameras_file, *_gamma_files(root)],
        files=files,
        cameras=cameras_of_views(cameras_file, numbers, cameras, "world_mat_"),
        read_stokes=None,
        masks=masks,
        mosaics=root / "raw",
        gamma=gamma,
        notes=(note,) if gamma != 1 else (),
    )


def _gamma_files(root: Path) -> list[Path]:
    return sorted(path for path in root.iterdir() if path.name.startswith("gamma"))


def _gamma(root: Path) -> float:
    """The number in the name of the gamma file; 1 without one."""
    files = _gamma_files(root)
    if not files:
        return 1.0
    try:
        gamma = float(files[0].name.removeprefix("gamma").removesuffix(".txt"))
    except ValueError:
        gamma = math.nan
    require_published(
        len(files) == 1 and 0.2 <= gamma <= 5,
        root,
        "one file called gamma<number>.txt with a number from 0.2 to 5",
        ", ".join(path.name for path in files),
    )
    return gamma


DATASETS: dict[str, tuple[tuple[str, ...], Callable[..., Dataset]]] = {
    "nersp": (("s0/", "s1/", "s2/"), open_nersp),
    "pisr": (("raw/", "intrinsics.npz"), open_pisr),
    "neisf": (("images_s0/", "images_s1/", "images_s2/"), open_neisf),
    "gnerp": (("cameras.json", "aop/", "dop/"), open_gnerp),
    "phygap": ((PHYGAP_CAMERAS,), open_phygap),
    "pandora": ((), open_pandora),
}
"""By name: the files and folders that a folder with the layout has, and the function that opens it. What lies in
``images_stokes/`` tells PANDORA from RMVP3D.
"""


def detect_dataset(root: Path) -> str | None:
    """The dataset whose layout a folder has, or None."""
    for folder in (root / name for name in STOKES_FOLDERS if (root / name).is_dir()):
        archived = any(path.suffix.lower() == ".npz" for path in folder.iterdir())
        return "nersp" if archived else "pandora"
    for name, (parts, _) in DATASETS.items():
        if parts and all(
            (root / part).is_dir() if part[-1] == "/" else (root / part).is_file() for part in parts
        ):
            return name
    return None


def open_dataset(root: Path, name: str, *, transfer: str = "auto") -> Dataset:
    """A folder of the dataset called ``name``.

    Args:
        root: the folder.
        name: a key of ``DATASETS``.
        transfer: encoding of GNeRP's pictures; ignored for the others.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    _, opened = DATASETS[name]
    return opened(root, transfer=transfer) if opened is open_gnerp else opened(root)
