"""GNeRP: display-encoded pictures, with angle and degree of polarization of one channel.

``images/<i>.png``; ``aop/<i>.npy`` in radians and ``dop/<i>.npy``, shared by R, G and B; ``masks/``; ``cameras.json``
with ``w2c_mat_<i>`` and ``intrinsic``. A picture is S0 / 2, so that with its linear values L: S0 = 2 L,
S1 = S0 DoP cos 2 AoP, S2 = S0 DoP sin 2 AoP.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.datasets.cameras import (
    checked_intrinsics,
    checked_pose,
    missing_entry,
    pinhole_camera,
)
from polarguide.capture.datasets.dataset import (
    Dataset,
    StokesImage,
    cameras_of_views,
    first_picture_size,
    masks_beside,
    not_as_published,
    numbered_views,
    require_files,
    require_same_shape,
)
from polarguide.capture.formats.arrays import array_kind, finite_numbers, read_array
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_picture, linear_codes
from polarguide.capture.layout import index_files
from polarguide.capture.view import FULL_CODE
from polarguide.records import read_record

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
    masks = masks_beside(root)
    cameras_file = root / "cameras.json"
    size = (
        first_picture_size({view: pictures[view] for view in numbers}, root / "images") if numbers else (1, 1)
    )

    def read_stokes(view: str) -> StokesImage:
        stored = decode_picture(pictures[view], read_picture(pictures[view]))
        aop, dop = (_plane(files[view], stored.shape, pictures[view]) for files in (angles, degrees))
        s0 = 2 * linear_codes(stored, transfer).astype(np.float32) / np.float32(FULL_CODE)
        stokes = [s0, s0 * (dop * np.cos(2 * aop))[..., None], s0 * (dop * np.sin(2 * aop))[..., None]]
        return np.stack(stokes), np.asarray((stored == np.iinfo(stored.dtype).max).any(axis=2))

    used = [files[view] for view in numbers for files in (pictures, angles, degrees)]
    return Dataset(
        name="gnerp",
        views=sorted(numbers),
        paths=[*used, *masks.values(), cameras_file],
        cameras=cameras_of_views(cameras_file, numbers, _cameras(cameras_file, size), "w2c_mat_"),
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
    if plane.ndim != 2 or plane.dtype.kind != "f":
        raise not_as_published(path, "floating-point numbers of one channel", array_kind(plane))
    require_same_shape(path, plane.shape, shape, like)
    return np.asarray(plane, np.float32)


def _cameras(path: Path, size: tuple[int, int]) -> dict[int, PosedCamera]:
    """Number -> camera, from ``w2c_mat_<i>`` and ``intrinsic``, or ``intrinsic_<i>`` where there is one."""
    content: dict[str, Any] = read_record(path, dict[str, Any])
    cameras = {}
    for key, value in content.items():
        match = re.fullmatch(r"w2c_mat_(\d{1,6})", key)
        if match is None:
            continue
        inner_key = f"intrinsic_{match[1]}" if f"intrinsic_{match[1]}" in content else "intrinsic"
        if inner_key not in content:
            raise missing_entry(path, inner_key, content)
        where = f"{path} ({inner_key})"
        inner = finite_numbers(where, content[inner_key], ((3, 3), *_SHAPES))[:3, :3]
        pose = checked_pose(f"{path} ({key})", finite_numbers(f"{path} ({key})", value, _SHAPES))
        cameras[int(match[1])] = pinhole_camera(size, checked_intrinsics(where, inner), *pose)
    if not cameras:
        raise missing_entry(path, "w2c_mat_<i>", content)
    return cameras
