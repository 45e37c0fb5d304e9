"""PISR: raw mosaics of a color sensor, a calibrated lens.

``raw/%03d.npy`` (12 bits in 16, 2448x2048); ``mask/%03d.png``; ``intrinsics.npz`` (camera_matrix at half the sensor's
size, dist_coeffs, both of OpenCV); ``cameras_sphere.npz`` for the poses; ``gamma<number>.txt``: stored values are the
light to the power of this number. ``image``, ``aop`` and ``dop`` are made from the raw files and not read.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from polarguide.capture.datasets.cameras import (
    checked_intrinsics,
    distorted_camera,
    missing_entry,
    read_projections,
)
from polarguide.capture.datasets.dataset import (
    Dataset,
    cameras_of_views,
    masks_beside,
    not_as_published,
    numbered_views,
)
from polarguide.capture.formats.arrays import finite_numbers, read_arrays
from polarguide.capture.layout import index_files

SENSOR: Final = "IMX250MYR"
SIZE = (1224, 1024)
"""Size that ``camera_matrix`` was made for."""
_CAMERAS = ("cameras_sphere.npz", "cameras.npz")


def open_pisr(root: Path) -> Dataset:
    """Find the files and read the cameras.

    Raises:
        PolarguideError: one is missing, or the cameras are invalid.
    """
    files = index_files(root / "raw", (".npy",))
    numbers = numbered_views(set(files))
    cameras_file = next((root / name for name in _CAMERAS if (root / name).exists()), root / _CAMERAS[0])
    inner_file = root / "intrinsics.npz"
    intrinsics = read_arrays(inner_file)
    for key in ("camera_matrix", "dist_coeffs"):
        if key not in intrinsics:
            raise missing_entry(inner_file, key, intrinsics)
    where = f"{inner_file} (camera_matrix)"
    inner = checked_intrinsics(where, finite_numbers(where, intrinsics["camera_matrix"], ((3, 3),)))
    coefficients = intrinsics["dist_coeffs"]
    cameras = {
        number: distorted_camera(f"{inner_file} (dist_coeffs)", SIZE, inner, coefficients, pose)
        for number, (_, *pose) in read_projections(cameras_file).items()
    }
    masks = masks_beside(root)
    gamma = _gamma(root)
    note = f"Stored values are the light to the power of {gamma:g} (gamma file): undone."
    return Dataset(
        name="pisr",
        views=sorted(numbers),
        paths=[*files.values(), *masks.values(), inner_file, cameras_file, *_gamma_files(root)],
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
    if len(files) > 1 or not 0.2 <= gamma <= 5:
        expected = "one file called gamma<number>.txt with a number from 0.2 to 5"
        raise not_as_published(root, expected, ", ".join(path.name for path in files))
    return gamma
