"""NeRSP (SMVP3D, RMVP3D): Stokes vectors as NumPy files.

``s0|s1|s2/%04d.npy``, twice the light; ``image/%04d.png`` (also ``images/``, ``I-sum/``);
``input_azimuth_maps/%04d.png``, whose last channel is the object mask, else ``mask/`` or ``masks/``; ``cameras.npz``
(also ``cameras_new.npz``, ``cameras_sphere.npz``). Its azimuths are measured with y down: angles count clockwise as
displayed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.datasets.cameras import pinhole_camera, read_projections
from polarguide.capture.datasets.dataset import (
    Dataset,
    cameras_of_views,
    first_picture_size,
    masks_beside,
    numbered_views,
    read_mask,
    stokes_dataset,
)
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_stored
from polarguide.capture.layout import index_files

_PARTS = ("s0", "s1", "s2")
_CAMERAS = ("cameras.npz", "cameras_new.npz", "cameras_sphere.npz")
_PICTURES = ("image", "images", "I-sum", "I_sum")


def open_nersp(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    cameras_file = next((root / name for name in _CAMERAS if (root / name).exists()), root / _CAMERAS[0])
    numbers = numbered_views({stem for part in _PARTS for stem in index_files(root / part, (".npy",))})
    files = {view: [root / part / f"{view}.npy" for part in _PARTS] for view in numbers}
    folder = next((root / name for name in _PICTURES if (root / name).is_dir()), root / _PICTURES[0])
    pictures = index_files(folder, SUFFIXES)
    maps = index_files(root / "input_azimuth_maps", (".png",))
    size = first_picture_size(pictures, folder) if numbers else (1, 1)
    found = {i: pinhole_camera(size, *camera) for i, camera in read_projections(cameras_file).items()}
    cameras = cameras_of_views(cameras_file, numbers, found, "world_mat_")
    masks, read = (maps, _last_channel) if maps else (masks_beside(root), read_mask)
    return stokes_dataset(
        "nersp", _PARTS, files, _halved, cameras_file, cameras, masks, read_mask=read, sense="cw"
    )


def _halved(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    return planes / np.float32(2)


def _last_channel(path: Path) -> NDArray[np.bool_]:
    pixels = decode_stored(path, read_picture(path))
    return np.asarray((pixels if pixels.ndim == 2 else pixels[..., -1]) > 0)
