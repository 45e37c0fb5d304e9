"""Camera paths.

A path leads around a scene, through the poses of its photographs, or comes from a file. A file is JSON,
``{"cameras": [...], "frames_per_second": 30}``. Each camera has ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``,
``rotation`` (world-to-camera, 9 numbers row by row) and ``translation`` (3 numbers), in OpenCV's axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from msgspec import Meta
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from polarguide.core.errors import require
from polarguide.core.records import read_record
from polarguide.geometry.camera import FARTHEST, LENS, Camera, can_be_lens, look_at
from polarguide.geometry.scene_frame import SceneFrame, scene_frame
from polarguide.geometry.vectors import dot, unit

LARGEST_SIDE = 8192
"""Maximum side of a picture in a file, in pixels."""
MOST_FRAMES = 100_000
"""Maximum number of cameras in a file."""
REMEDY = (
    "Specify orbit, spiral, turntable or interpolate, or a JSON file with cameras as described in "
    "docs/how-to/export.md."
)
"""Remedy for errors in camera paths."""
Side = Annotated[int, Meta(ge=1, le=LARGEST_SIDE)]
"""Side of a picture in a file."""


def orbit(
    cameras: Sequence[Camera],
    frames: int,
    *,
    swing: float = 0.0,
    around: SceneFrame | None = None,
    distance: float | None = None,
) -> list[Camera]:
    """Return a path once around the scene at the cameras' median height and distance.

    The path starts on the side of the first camera, and all its cameras have the lens of this camera.

    Args:
        cameras: cameras of the scene, at least one.
        frames: number of pictures. The last picture is one step before the first.
        swing: amplitude of two vertical oscillations, as a share of the distance.
        around: frame of the scene. With None, it is estimated from the cameras.
        distance: distance from the frame's center, at the same elevation. None means the distance of the cameras.
    """
    around = around or scene_frame(cameras)
    ahead, side = _level_axes(around, cameras[0].center)
    offsets = torch.stack([camera.center for camera in cameras]) - around.center
    height = float((offsets @ around.up).median())
    level = offsets - (offsets @ around.up)[:, None] * around.up
    radius = max(float(level.norm(dim=1).median()), 1e-6 * around.distance)
    if distance is not None:
        scale = distance / math.hypot(radius, height)
        radius *= scale
        height *= scale
    path = []
    for k in range(frames):
        angle = 2 * math.pi * k / frames
        lift = height + swing * around.distance * math.sin(2 * angle)
        eye = around.center + radius * (math.cos(angle) * ahead + math.sin(angle) * side) + lift * around.up
        rotation, translation = look_at(eye, around.center, around.up)
        path.append(replace(cameras[0], rotation=rotation, translation=translation))
    return path


def interpolated(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Return a smooth path of ``frames`` cameras through given cameras, in their order.

    Positions follow a cubic spline, and rotations follow SciPy's ``RotationSpline``. A camera at the same position as
    the previous camera is skipped.
    """
    keyframes = list(cameras[:1])
    for camera in cameras[1:]:
        if float((camera.center - keyframes[-1].center).norm()) > 1e-9:
            keyframes.append(camera)
    if len(keyframes) == 1:
        return keyframes * frames
    times = np.arange(len(keyframes))
    sampled = np.linspace(0, len(keyframes) - 1, frames)
    centers = CubicSpline(times, torch.stack([camera.center for camera in keyframes]).numpy())(sampled)
    turns = Rotation.from_matrix(torch.stack([camera.rotation for camera in keyframes]).numpy())
    rotations = RotationSpline(times, turns)(sampled).as_matrix()
    path = []
    for center, matrix in zip(centers, rotations, strict=True):
        rotation = torch.from_numpy(np.ascontiguousarray(matrix))
        path.append(
            replace(keyframes[0], rotation=rotation, translation=-rotation @ torch.from_numpy(center))
        )
    return path


def _level_axes(around: SceneFrame, begin: Tensor) -> tuple[Tensor, Tensor]:
    """Return the level direction from the center to ``begin`` [3], and that direction turned left by 90 degrees."""
    offset = begin - around.center
    level = offset - dot(offset, around.up) * around.up
    if float(level.norm()) < 1e-6 * around.distance:
        level = -around.panorama_axes()[:, 2]
    ahead = unit(level, 1e-12)
    return ahead, torch.linalg.cross(around.up, ahead)


def camera_record(camera: Camera) -> dict[str, Any]:
    """Return the record of a camera in a file."""
    return {
        **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "rotation": camera.rotation.flatten().tolist(),
        "translation": camera.translation.tolist(),
    }


class _CameraRecord(msgspec.Struct):
    """Camera in a file."""

    width: Side
    height: Side
    fx: Annotated[float, Meta(gt=0)]
    fy: Annotated[float, Meta(gt=0)]
    cx: float
    cy: float
    rotation: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]
    translation: tuple[float, float, float]


class _PathRecord(msgspec.Struct):
    """File with a camera path."""

    cameras: Annotated[list[_CameraRecord], Meta(min_length=1, max_length=MOST_FRAMES)]
    frames_per_second: Annotated[float, Meta(gt=0, le=1000)] = 30


def read_path(path: Path) -> tuple[list[Camera], float]:
    """Read the cameras of a file and its frames per second, which are 30 by default.

    Raises:
        PolarguideError: the file does not exist, or differs from the format that the module describes.
    """
    record = read_record(path, _PathRecord, remedy=REMEDY)
    cameras = [_camera_of(camera, f"{path} (cameras[{k}]") for k, camera in enumerate(record.cameras)]
    return cameras, record.frames_per_second


def _camera_of(record: _CameraRecord, where: str) -> Camera:
    """Check and convert a camera of a file. ``where`` names the file and the camera in messages."""
    place = list(record.translation)
    rotation = torch.tensor(record.rotation, dtype=torch.float64).reshape(3, 3)
    is_orthogonal = torch.dist(rotation @ rotation.T, torch.eye(3, dtype=torch.float64)) < 1e-3
    lens = f"fx {record.fx:g}, fy {record.fy:g}, cx {record.cx:g}, cy {record.cy:g}"
    for is_valid, part, expected, found in (
        (
            can_be_lens((record.width, record.height), (record.fx, record.fy), (record.cx, record.cy)),
            "",
            f"numbers up to {FARTHEST:g}, {LENS}",
            f"{lens} for {record.width} x {record.height} pixels",
        ),
        (max(map(abs, place)) <= FARTHEST, ".translation", f"numbers up to {FARTHEST:g}", str(place)),
        (
            is_orthogonal and float(torch.linalg.det(rotation)) > 0,
            ".rotation",
            "a rotation",
            str(list(record.rotation)),
        ),
    ):
        require(is_valid, f"{where}{part})", expected=expected, found=found, remedy=REMEDY)
    return Camera(
        record.width, record.height, record.fx, record.fy, record.cx, record.cy,
        rotation, torch.tensor(place, dtype=torch.float64),
    )  # fmt: skip
