"""PANDORA: Stokes vectors as HDR pictures, cameras of the RGB pictures beside them.

``images_stokes/%02d_s0.hdr, _s0p1.hdr, _s0p2.hdr`` with S0 = s0 / 2, S1 = (s0p1 - s0) / 2, S2 = (s0p2 - s0) / 2;
``images/``, which the intrinsics were made for; ``mask/%02d.png``; ``cameras.npz``. Files count from 1 and cameras
from 0, as in its release; where there is a file 00, files count from 0.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.datasets.cameras import pinhole_camera, read_projections
from polarguide.capture.datasets.dataset import (
    Dataset,
    cameras_of_views,
    first_picture_size,
    masks_beside,
    stokes_dataset,
)
from polarguide.capture.formats.pictures import SUFFIXES
from polarguide.capture.layout import index_files

_PARTS = ("s0", "s0p1", "s0p2")
_STEM = re.compile(r"(?P<view>\d{1,6})_(?P<part>s0|s0p1|s0p2)")


def open_pandora(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    folder, cameras_file = root / "images_stokes", root / "cameras.npz"
    matches = [_STEM.fullmatch(stem) for stem in index_files(folder, (".hdr",))]
    views = sorted({match["view"] for match in matches if match is not None})
    files = {view: [folder / f"{view}_{part}.hdr" for part in _PARTS] for view in views}
    masks = masks_beside(root)
    pictures = index_files(root / "images", SUFFIXES)
    first = 0 if any(int(view) == 0 for view in views) else 1
    size = first_picture_size(pictures, root / "images") if views else (1, 1)
    found = {i: pinhole_camera(size, *camera) for i, camera in read_projections(cameras_file).items()}
    numbers = {view: int(view) - first for view in views}
    cameras = cameras_of_views(cameras_file, numbers, found, "world_mat_")
    notes = (f"Files count from {first}, cameras from 0.",)
    return stokes_dataset("pandora", _PARTS, files, _stokes, cameras_file, cameras, masks, notes=notes)


def _stokes(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    total, plus1, plus2 = planes
    return np.asarray(np.stack([total, plus1 - total, plus2 - total]) / np.float32(2), np.float32)
