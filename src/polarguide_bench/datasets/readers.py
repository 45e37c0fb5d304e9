"""Readers of published datasets: PANDORA, NeRSP, NeISF, GNeRP, PhyGaP and PISR."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.camera_matrices import (
    POSE_SHAPES,
    checked_intrinsics,
    checked_pose,
    pinhole_camera,
    read_projections,
    require_entries,
    require_known_names,
)
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.formats.pictures import (
    array_kind,
    array_size,
    decode_arrays,
    decode_picture,
    finite_numbers,
    linear_codes,
    read_array,
    read_arrays,
    read_exr,
    read_mask,
)
from polarguide.capture.formats.stored import (
    LARGEST_PIXELS,
    SUFFIXES,
    decode_stored,
    read_picture,
    stated_size,
)
from polarguide.capture.layout import index_files, numbered_views
from polarguide.capture.pose_files import Size, is_centered
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideWarning
from polarguide.core.files import read_file
from polarguide.core.records import read_record
from polarguide.core.text import listed, number_or_nan
from polarguide.preparation.datasets import STOKES_FOLDERS, first_existing
from polarguide_bench.datasets.dataset import (
    Dataset,
    StokesImage,
    cameras_of_views,
    distorted_camera,
    first_picture_size,
    masks_beside,
    require_files,
    require_published,
    require_same_shape,
    stokes_dataset,
)

_PICTURES = ("image", "images", "train", "I-sum", "I_sum")
_MAPS = ("input_azimuth_maps", "train_input_azimuth_maps")
_PANDORA_PARTS = ("s0", "s0p1", "s0p2")
_PANDORA_STEM = re.compile(r"(?P<view>\d{1,6})_(?P<part>s0|s0p1|s0p2)")


def open_pandora(root: Path) -> Dataset:
    """Open the dataset PANDORA, or a copy of it that NeRSP or PolGS distribute.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    folder = first_existing(root, STOKES_FOLDERS)
    cameras_file = root / "cameras.npz"
    matches = [_PANDORA_STEM.fullmatch(stem) for stem in index_files(folder, (".hdr",))]
    views = sorted({match["view"] for match in matches if match is not None})
    files = {view: [folder / f"{view}_{part}.hdr" for part in _PANDORA_PARTS] for view in views}
    pictures = index_files(first_existing(root, _PICTURES), SUFFIXES)
    numbers = {view: int(view) for view in views}
    # The first view has the number 1, unless a file has the name 00.
    first = 0 if 0 in numbers.values() or "00" in pictures else 1
    cameras: dict[str, PosedCamera] | None = None
    notes: tuple[str, ...] = ()
    # PhyGaP's copy has a COLMAP model instead of the cameras.
    posed = cameras_file.exists() or not (root / "sparse").is_dir()
    if posed:
        offsets = (0,) if first == 0 else None
        light = files[views[0]][0] if views else None
        cameras, offset = _cameras(root, cameras_file, numbers, pictures, light, offsets)
        notes = (f"Files count from {first}, cameras from {first + offset}.",)
    masks, read_mask = _masks(root, numbers, first)
    return stokes_dataset(
        "pandora", _PANDORA_PARTS, files, cameras_file if posed else None, cameras, masks,
        stokes=_stokes_of_sums, read_mask=read_mask, notes=notes,
    )  # fmt: skip


def _stokes_of_sums(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert the three pictures S0, S0 + S1 and S0 + S2 to Stokes vectors."""
    total, plus1, plus2 = planes
    return np.asarray(np.stack([total, plus1 - total, plus2 - total]) / np.float32(2), np.float32)


_NERSP_PARTS = ("s0", "s1", "s2")
_NERSP_ENTRIES = ("S0", "S1", "S2")
_NERSP_CAMERAS = ("cameras.npz", "cameras_new.npz", "cameras_sphere.npz")


def open_nersp(root: Path) -> Dataset:
    """Open the dataset NeRSP, or the copy of it that PolGS distributes.

    NeRSP consists of SMVP3D, and of RMVP3D, which has one archive for each view.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    cameras_file = first_existing(root, _NERSP_CAMERAS)
    archives = index_files(first_existing(root, STOKES_FOLDERS), (".npz",))
    stems = set(archives) or {stem for part in _NERSP_PARTS for stem in index_files(root / part, (".npy",))}
    views = numbered_views(stems)
    pictures = index_files(first_existing(root, _PICTURES), SUFFIXES)
    light = None if archives else next(iter(sorted((root / _NERSP_PARTS[0]).glob("*.npy"))), None)
    cameras, _ = _cameras(root, cameras_file, views, pictures, light, (0,))
    masks, read_mask = _masks(root, views, 0)
    settings: dict[str, Any] = {
        "stokes": _halved,
        "read_mask": read_mask,
        "sense": "cw",
        "sense_known": False,
    }
    if archives:
        stored = {view: [archives[view]] for view in views}
        return stokes_dataset(
            "nersp", ("archive",), stored, cameras_file, cameras, masks, read=_read_archive, **settings
        )
    files = {view: [root / part / f"{view}.npy" for part in _NERSP_PARTS] for view in views}
    return stokes_dataset("nersp", _NERSP_PARTS, files, cameras_file, cameras, masks, **settings)


def _halved(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Divide Stokes vectors by 2."""
    return planes / np.float32(2)


def _read_archive(paths: Sequence[Path]) -> NDArray[np.float32]:
    """Read the Stokes vectors of a view of RMVP3D, [3, H, W, 3], from the entries S0, S1 and S2 of its archive.

    Raises:
        PolarguideError: the file cannot be read, an entry is missing, or the entries are not pictures of equal size.
    """
    (path,) = paths
    arrays = decode_arrays(path, read_file(path), _NERSP_ENTRIES, 3 * 8 * 3 * LARGEST_PIXELS, kinds="biufcSU")
    for key in _NERSP_ENTRIES:
        require_published(key in arrays, path, f"the entry {key}", listed(sorted(arrays)) or "no entry")
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


def _cameras(
    root: Path,
    path: Path,
    views: Mapping[str, int],
    pictures: Mapping[str, Path],
    light: Path | None,
    offsets: tuple[int, ...] | None,
) -> tuple[dict[str, PosedCamera], int]:
    """Read the camera of each view.

    The numbers of the cameras start at 0 (``world_mat_0``), or at 1 (``world_mat_01``) in the original of PANDORA and
    the copies of PolGS. The smallest number in the file decides which numbering applies. Every view must have a camera
    with the chosen offset. A missing camera therefore causes an error and cannot shift all other cameras.

    Args:
        root: folder of the dataset.
        path: file of the cameras.
        views: number of each view by name.
        pictures: pictures to which the intrinsics refer, by name.
        light: a file of Stokes vectors. If the pictures were resized later, the intrinsics refer to the size of this
            file.
        offsets: possible offsets if the numbers of the views start at 0; None if they start at 1.

    Returns:
        The cameras by view name; and the offset, which is the number of a camera minus the number of its view.
    """
    projections = read_projections(path)
    known = projections.cameras
    size = (1, 1)
    if views:
        size = first_picture_size(pictures, first_existing(root, _PICTURES))
        size = _camera_size(path, [inner for inner, *_ in known.values()], size, light)
    if offsets is None:
        offsets = (-1,) if 0 in known else (0, -1)
    elif projections.padded and 0 not in known and "00" not in pictures:
        offsets = (1, *offsets)
    chosen = next(
        (offset for offset in offsets if all(number + offset in known for number in views.values())),
        offsets[-1],
    )
    cameras = {number: pinhole_camera(size, *camera) for number, camera in known.items()}
    return cameras_of_views(
        path, {view: number + chosen for view, number in views.items()}, cameras, "world_mat_"
    ), chosen


def _camera_size(path: Path, inner: Sequence[NDArray[np.float64]], size: Size, light: Path | None) -> Size:
    """Return the width and height to which the intrinsics of cameras refer.

    It is the size of the pictures, or the size of the Stokes vectors if the pictures were resized later.

    Args:
        path: file of the cameras for messages.
        inner: intrinsic matrices of the cameras.
        size: width and height of the pictures.
        light: a file of Stokes vectors.
    """
    centers = [(float(matrix[0, 2]), float(matrix[1, 2])) for matrix in inner]
    other = None if light is None else stated_size(light)
    for candidate in (size, *([] if other is None else [other])):
        if all(is_centered(candidate, center) for center in centers):
            return candidate
    warnings.warn(
        f"{path.name}: principal points are far from the middle of the pictures, {size[0]}x{size[1]}. This is a sign "
        "of cropped or resized pictures. Their size is used nevertheless.",
        PolarguideWarning,
        stacklevel=2,
    )
    return size


def _masks(
    root: Path, views: Mapping[str, int], first: int
) -> tuple[dict[str, Path], Callable[[Path], NDArray[np.bool_]]]:
    """Find the foreground masks of the views.

    The masks are pictures in ``mask/`` or ``masks/``. If these folders do not exist, the last channels of NeRSP's
    azimuth maps are used.

    Args:
        root: folder of the dataset.
        views: number of each view by name.
        first: number of the first view. The number of the first azimuth map is always 0.

    Returns:
        The file of the mask by view name, and the function that reads such a file.
    """
    maps = index_files(first_existing(root, _MAPS), (".png",))
    if not maps:
        return masks_beside(root, views), read_mask
    by_index = {number: maps[stem] for stem, number in numbered_views(set(maps)).items()}
    indices = {view: number - first for view, number in views.items()}
    return {view: by_index[index] for view, index in indices.items() if index in by_index}, _last_channel


def _last_channel(path: Path) -> NDArray[np.bool_]:
    """Read the mask in the last channel of NeRSP's azimuth maps."""
    pixels = decode_stored(path, read_picture(path))
    return np.asarray((pixels if pixels.ndim == 2 else pixels[..., -1]) > 0)


_NEISF_PARTS = ("images_s0", "images_s1", "images_s2")
_NEISF_STEM = re.compile(r"img_(\d{1,6})")


def open_neisf(root: Path) -> Dataset:
    """Open the dataset NeISF.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    matches = [
        _NEISF_STEM.fullmatch(stem) for part in _NEISF_PARTS for stem in index_files(root / part, (".exr",))
    ]
    numbers = {match[0]: int(match[1]) for match in matches if match is not None}
    files = {view: [root / part / f"{view}.exr" for part in _NEISF_PARTS] for view in numbers}
    cameras_file = root / "poses_bounds.npy"
    cameras = cameras_of_views(cameras_file, numbers, _llff_cameras(cameras_file), "row ")
    return stokes_dataset(
        "neisf", _NEISF_PARTS, files, cameras_file, cameras, masks_beside(root, numbers), sense_known=False
    )


def _llff_cameras(path: Path) -> dict[int, PosedCamera]:
    """Read the cameras of a file in LLFF's format. The key of a camera is the number of its row; the first row is 1."""
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
        # The axes are converted to those of OpenCV: right, down, forward.
        axes = np.column_stack([np.stack([right, down, -back]), np.zeros(3)])
        rotation, _ = checked_pose(where, axes)
        middle = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras[index + 1] = pinhole_camera(
            (round(width), round(height)), middle, rotation, -rotation @ center
        )
    return cameras


def open_gnerp(root: Path, *, transfer: str) -> Dataset:
    """Open the dataset GNeRP.

    Args:
        root: folder of the dataset.
        transfer: encoding of the pictures, "linear" or "srgb". "auto" means "srgb".

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
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
        largest = float(np.nanmax(np.abs(aop)))
        require_published(not largest > 2 * math.pi, angles[view], "angles in radians", f"up to {largest:g}")
        middle = float(np.nanmedian(dop))
        require_published(not middle > 1, degrees[view], "degrees from 0 to 1", f"a median of {middle:g}")
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
            "AoP and DoP have one channel, which R, G and B share.",
            f"The pictures are read as {transfer}"
            + (" and made linear before Stokes vectors are computed (change with --transfer)."
               if transfer == "srgb" else "."),
        ),
    )  # fmt: skip


def _plane(path: Path, shape: tuple[int, ...], like: Path) -> NDArray[np.float32]:
    """Read an array of shape [H, W] or [H, W, 1] from a file, and return it as [H, W]."""
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
    """Read cameras by number from the arrays ``w2c_mat_<i>`` and ``intrinsic_<i>``.

    The array ``intrinsic`` applies to cameras without intrinsics of their own.
    """
    content: dict[str, Any] = read_record(path, dict[str, Any])
    cameras = {}
    for key, value in content.items():
        match = re.fullmatch(r"w2c_mat_(\d{1,6})", key)
        if match is None:
            continue
        inner_key = f"intrinsic_{match[1]}" if f"intrinsic_{match[1]}" in content else "intrinsic"
        require_entries(path, content, inner_key)
        where = f"{path} ({inner_key})"
        pose = checked_pose(f"{path} ({key})", finite_numbers(f"{path} ({key})", value, POSE_SHAPES))
        cameras[int(match[1])] = pinhole_camera(size, checked_intrinsics(where, content[inner_key]), *pose)
    if not cameras:
        require_entries(path, content, "w2c_mat_<i>")
    require_known_names(path, (key for key in content if _GNERP_ENTRY.fullmatch(key) is None))
    return cameras


_PHYGAP_ENTRIES = {"intrinsics", "extrinsics", "image_width", "image_height", "fov"}
"""Known entries of the camera file. The angle of view (``fov``) is redundant and not used."""
_CHANNELS = tuple(f"S{part}.{color}" for part in range(3) for color in "RGB")


def open_phygap(root: Path) -> Dataset:
    """Open the dataset PhyGaP.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    stored = index_files(first_existing(root, ("images_full", "images")), (".exr",))
    numbers = numbered_views(set(stored))
    path = root / "camera_params.npz"
    arrays = read_arrays(path)
    require_entries(path, arrays, "intrinsics", "extrinsics", "image_width", "image_height")
    require_known_names(path, arrays.keys() - _PHYGAP_ENTRIES)
    inner = checked_intrinsics(f"{path} (intrinsics)", arrays["intrinsics"])
    poses = arrays["extrinsics"]
    require_published(
        poses.ndim == 3 and poses.shape[1:] in POSE_SHAPES,
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
        cameras[number] = pinhole_camera(
            size, inner, *checked_pose(where, finite_numbers(where, pose, POSE_SHAPES))
        )

    return stokes_dataset(
        "phygap",
        ("Stokes vectors",),
        {view: [stored[view]] for view in numbers},
        path,
        cameras_of_views(path, numbers, cameras, "extrinsics "),
        masks_beside(root, numbers),
        read=_read_mitsuba,
        notes=("Angles of Mitsuba start at the vertical of the picture: turned by 90 degrees.",),
    )


def _read_mitsuba(paths: Sequence[Path]) -> NDArray[np.float32]:
    """Read the Stokes vectors of a view rendered by Mitsuba, [3, H, W, 3].

    Mitsuba measures angles from the vertical of the picture. They are converted to angles from the horizontal.
    """
    (path,) = paths
    s0, s1, s2 = np.split(read_exr(path, _CHANNELS), 3, axis=2)
    return np.stack([s0, -s1, -s2])


_PISR_SIZE = (1224, 1024)
"""Width and height of the pictures to which ``camera_matrix`` refers."""
# Known entries of the camera file. The poses of the calibration target and the error of the calibration are not used.
_PISR_ENTRIES = {"camera_matrix", "dist_coeffs", "rvecs", "tvecs", "ret", "rms"}
_PISR_CAMERAS = ("cameras_sphere.npz", "cameras.npz")


def open_pisr(root: Path) -> Dataset:
    """Open the dataset PISR.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    files = index_files(root / "raw", (".npy",))
    numbers = numbered_views(set(files))
    cameras_file = first_existing(root, _PISR_CAMERAS)
    inner_file = root / "intrinsics.npz"
    intrinsics = read_arrays(inner_file)
    require_entries(inner_file, intrinsics, "camera_matrix", "dist_coeffs")
    require_known_names(inner_file, intrinsics.keys() - _PISR_ENTRIES)
    inner = checked_intrinsics(f"{inner_file} (camera_matrix)", intrinsics["camera_matrix"])
    coefficients = intrinsics["dist_coeffs"]
    cameras = {
        number: distorted_camera(f"{inner_file} (dist_coeffs)", _PISR_SIZE, inner, coefficients, pose)
        for number, (_, *pose) in read_projections(cameras_file).cameras.items()
    }
    masks = masks_beside(root, numbers)
    gamma_files = sorted(path for path in root.iterdir() if path.name.startswith("gamma"))
    gamma = _gamma(root, gamma_files)
    note = f"Stored values are the light to the power of {gamma:g} (gamma file), which is undone."
    return Dataset(
        name="pisr",
        views=sorted(numbers),
        paths=[*files.values(), *masks.values(), inner_file, cameras_file, *gamma_files],
        files=files,
        cameras=cameras_of_views(cameras_file, numbers, cameras, "world_mat_"),
        read_stokes=None,
        masks=masks,
        mosaics=root / "raw",
        gamma=gamma,
        notes=(note,) if gamma != 1 else (),
    )


def _gamma(root: Path, files: Sequence[Path]) -> float:
    """Return the gamma of the mosaics, which the name of a file states. Return 1 if the file does not exist."""
    if not files:
        return 1.0
    gamma = number_or_nan(files[0].name.removeprefix("gamma").removesuffix(".txt"))
    require_published(
        len(files) == 1 and 0.2 <= gamma <= 5,
        root,
        "one file called gamma<number>.txt with a number from 0.2 to 5",
        ", ".join(path.name for path in files),
    )
    return gamma


READERS: dict[str, Callable[..., Dataset]] = {
    "nersp": open_nersp,
    "pisr": open_pisr,
    "neisf": open_neisf,
    "gnerp": open_gnerp,
    "phygap": open_phygap,
    "pandora": open_pandora,
}
"""Reader of each dataset by name."""


def open_dataset(root: Path, name: str, *, transfer: str = "auto") -> Dataset:
    """Open a folder of a dataset.

    Args:
        root: folder of the dataset.
        name: a key of ``READERS``.
        transfer: encoding of GNeRP's pictures; other datasets ignore it.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    open_files = READERS[name]
    return open_files(root, transfer=transfer) if open_files is open_gnerp else open_files(root)
