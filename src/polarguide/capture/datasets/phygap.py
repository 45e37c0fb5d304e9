"""PhyGaP's rendered scenes: Stokes vectors of Mitsuba as EXR pictures, cameras in one file.

``camera_params.npz``: ``intrinsics`` [3, 3] for ``image_width`` x ``image_height``, ``extrinsics`` [N, 4, 4] world to
camera in OpenCV's axes; ``images_full/%03d.exr`` with channels S0.R to S2.B (also ``images/``); ``masks/%03d.*``.
Mitsuba counts angles from the picture's vertical, counter-clockwise as displayed: S1 and S2 have the other sign here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

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
    masks_beside,
    not_as_published,
    numbered_views,
)
from polarguide.capture.formats.arrays import array_size, finite_numbers, read_arrays
from polarguide.capture.formats.radiance import read_exr_channels
from polarguide.capture.layout import index_files

CAMERAS = "camera_params.npz"
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
    path = root / CAMERAS
    arrays = read_arrays(path)
    for key in ("intrinsics", "extrinsics", "image_width", "image_height"):
        if key not in arrays:
            raise missing_entry(path, key, arrays)
    inner = checked_intrinsics(f"{path} (intrinsics)", finite_numbers(path, arrays["intrinsics"], ((3, 3),)))
    poses = arrays["extrinsics"]
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)):
        raise not_as_published(f"{path} (extrinsics)", "matrices N x 4 x 4", array_size(poses))
    sides = [finite_numbers(f"{path} ({key})", arrays[key], ((),)) for key in ("image_width", "image_height")]
    if not all(1 <= side <= 1e5 for side in sides):
        found = " and ".join(f"{float(side):g}" for side in sides)
        raise not_as_published(f"{path} (image_width, image_height)", "a size in pixels", found)
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

    masks = masks_beside(root)
    return Dataset(
        name="phygap",
        views=sorted(numbers),
        paths=[*(files[view] for view in numbers), *masks.values(), path],
        cameras=cameras_of_views(path, numbers, cameras, "extrinsics "),
        read_stokes=read_stokes,
        masks=masks,
        notes=("Angles of Mitsuba count from the vertical of the picture: turned by 90 degrees.",),
    )
