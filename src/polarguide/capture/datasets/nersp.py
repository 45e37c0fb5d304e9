"""NeRSP (SMVP3D, RMVP3D): Stokes vectors as NumPy files.

``s0|s1|s2/%04d.npy``, twice the light; ``image/%04d.png``; ``input_azimuth_maps/%04d.png``, whose last channel is the
object mask; ``cameras.npz``. Its azimuths are measured with y down: angles count clockwise as displayed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.datasets.cameras import pinhole_camera, read_projections
from polarguide.capture.datasets.dataset import (
    Dataset,
    StokesImage,
    cameras_of_views,
    first_picture_size,
    numbered_views,
    require_files,
    require_same_shape,
)
from polarguide.capture.formats.pictures import SUFFIXES, decode_stored, read_file
from polarguide.capture.formats.radiance import read_radiance
from polarguide.capture.layout import index_files

_PARTS = ("s0", "s1", "s2")


def is_nersp(root: Path) -> bool:
    """Whether a folder has the layout."""
    return all((root / part).is_dir() for part in _PARTS)


def open_nersp(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    cameras_file = root / "cameras.npz"
    numbers = numbered_views({stem for part in _PARTS for stem in index_files(root / part, (".npy",))})
    files = {view: [root / part / f"{view}.npy" for part in _PARTS] for view in numbers}
    for index, part in enumerate(_PARTS):
        require_files({view: paths[index] for view, paths in files.items()}, part)
    pictures = index_files(root / "image", SUFFIXES)
    maps = index_files(root / "input_azimuth_maps", (".png",))
    size = first_picture_size(pictures, root / "image") if numbers else (1, 1)
    found = {i: pinhole_camera(size, *camera) for i, camera in read_projections(cameras_file).items()}

    def read_stokes(view: str) -> StokesImage:
        planes = [read_radiance(path) for path in files[view]]
        for path, plane in zip(files[view], planes, strict=True):
            require_same_shape(path, plane.shape, planes[0].shape, files[view][0])
        return StokesImage(np.stack(planes) / np.float32(2), np.zeros(planes[0].shape[:2], bool))

    def mask(view: str) -> NDArray[np.bool_] | None:
        path = maps.get(view)
        if path is None:
            return None
        pixels = decode_stored(path, read_file(path))
        return np.asarray((pixels if pixels.ndim == 2 else pixels[..., -1]) > 0)

    return Dataset(
        name="nersp",
        views=sorted(numbers),
        paths=[*(p for paths in files.values() for p in paths), *maps.values(), cameras_file],
        cameras=cameras_of_views(cameras_file, numbers, found, "world_mat_"),
        read_stokes=read_stokes,
        mask=mask,
        sense="cw",
    )
