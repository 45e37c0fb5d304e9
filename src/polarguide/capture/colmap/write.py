"""Write a COLMAP model of posed cameras without points."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.camera import quaternion

MODELS = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "FOV": (7, 5), "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5), "THIN_PRISM_FISHEYE": (10, 12),
}  # fmt: skip
"""COLMAP's camera models: number and count of parameters."""


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """Intrinsics and pose of one picture, in COLMAP's conventions.

    Attributes:
        width, height: picture size in pixels.
        model: a key of ``MODELS``.
        parameters: in COLMAP's order; pixel centers at 0.5.
        rotation: world to camera, [3, 3].
        translation: world to camera, [3].
    """

    width: int
    height: int
    model: str
    parameters: tuple[float, ...]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def intrinsics(self) -> tuple[Any, ...]:
        """Model, size and parameters: equal for pictures of one camera."""
        return (self.model, self.width, self.height, *self.parameters)

    @property
    def center(self) -> NDArray[np.float64]:
        """Camera center in the world, [3]."""
        return np.asarray(-self.rotation.T @ self.translation)


def colmap_camera(camera: PosedCamera, **more: Any) -> pycolmap.Camera:
    """The intrinsics of a camera as pycolmap's type."""
    size, params = {"width": camera.width, "height": camera.height}, list(camera.parameters)
    return pycolmap.Camera(model=camera.model, params=params, **size, **more)


def write_cameras(
    folder: Path, cameras: Mapping[str, PosedCamera], numbers: Mapping[str, tuple[int, int]] | None = None
) -> None:
    """Write a binary COLMAP model with one image ``<view>.png`` a view and no points.

    Views that share their intrinsics share a camera.

    Args:
        folder: exists.
        cameras: by view name; may not be empty.
        numbers: of each view's image and camera; counted from 1 if None.
    """
    found: dict[tuple[object, ...], int] = {}
    used: dict[int, tuple[Any, ...]] = {}
    images = []
    for number, (view, camera) in enumerate(sorted(cameras.items()), 1):
        of_camera = found.setdefault(camera.intrinsics, len(found) + 1)
        if numbers is not None:
            number, of_camera = numbers[view]
        used[of_camera] = camera.intrinsics
        pose = (*quaternion(camera.rotation), *camera.translation)
        name = f"{view}.png".encode() + b"\0"
        images.append(struct.pack("<I7dI", number, *pose, of_camera) + name + struct.pack("<Q", 0))
    intrinsics = []
    for number, (model, width, height, *parameters) in used.items():
        head = struct.pack("<IiQQ", number, MODELS[str(model)][0], width, height)
        intrinsics.append(head + struct.pack(f"<{len(parameters)}d", *parameters))
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(intrinsics)) + b"".join(intrinsics))
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
