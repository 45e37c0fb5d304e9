"""NeISF: signed Stokes vectors as EXR pictures, one focal length, poses of LLFF.

``images_s0|s1|s2/img_%03d.exr`` and ``masks/img_%03d.png``, counted from 1; ``poses_bounds.npy``, [N, 17], one row a
picture: a 3x5 matrix (camera axes down, right, back and center in the world; height, width, focal length), two bounds.
Its release does not state the sense of its angles.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.datasets.cameras import checked_pose, pinhole_camera
from polarguide.capture.datasets.dataset import (
    Dataset,
    cameras_of_views,
    masks_beside,
    not_as_published,
    stokes_dataset,
)
from polarguide.capture.formats.arrays import array_size, finite_numbers, read_array
from polarguide.capture.layout import index_files

_PARTS = ("images_s0", "images_s1", "images_s2")
_STEM = re.compile(r"img_(\d{1,6})")


def open_neisf(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    matches = [_STEM.fullmatch(stem) for part in _PARTS for stem in index_files(root / part, (".exr",))]
    numbers = {match[0]: int(match[1]) for match in matches if match is not None}
    files = {view: [root / part / f"{view}.exr" for part in _PARTS] for view in numbers}
    cameras_file = root / "poses_bounds.npy"
    cameras = cameras_of_views(cameras_file, numbers, _cameras(cameras_file), "row ")
    masks = masks_beside(root)
    note = "The sense of NeISF's angles is not stated by its release: taken as counter-clockwise (--sense cw if not)."
    return stokes_dataset(
        "neisf", _PARTS, files, lambda planes: planes, cameras_file, cameras, masks, notes=(note,)
    )


def _cameras(path: Path) -> dict[int, PosedCamera]:
    """Row -> camera; rows count from 1 like the files."""
    rows = read_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise not_as_published(path, "an array N x 17 of poses and bounds (LLFF)", array_size(rows))
    cameras = {}
    for index, row in enumerate(rows):
        where = f"{path} (row {index})"
        down, right, back, center, inner = finite_numbers(where, row[:15], ((15,),)).reshape(3, 5).T
        height, width, focal = inner
        if not (1 <= height <= 1e5 and 1 <= width <= 1e5 and focal > 0):
            found = f"{height:g}, {width:g} and {focal:g}"
            raise not_as_published(where, "height, width and focal length in pixels", found)
        # OpenCV's axes: right, down, forward.
        axes = np.column_stack([np.stack([right, down, -back]), np.zeros(3)])
        rotation, _ = checked_pose(where, axes)
        middle = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        size = round(width), round(height)
        cameras[index + 1] = pinhole_camera(size, middle, rotation, -rotation @ center)
    return cameras
