"""Camera paths: around a scene, through its photographs' poses, or from a file.

A file is JSON, ``{"cameras": [...], "frames_per_second": 30}``, each camera with ``width``, ``height``, ``fx``, ``fy``,
``cx``, ``cy``, ``rotation`` (world to camera, 9 numbers row by row) and ``translation`` (3 numbers), in OpenCV's axes.
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
MOST_FRAMES = 100_000
REMEDY = "Give orbit, spiral, turntable, interpolate, or a JSON file with cameras as docs/how-to/export.md shows it."
Side = Annotated[int, Meta(ge=1, le=LARGEST_SIDE)]


def orbit(
    cameras: Sequence[Camera],
    frames: int,
    *,
    swing: float = 0.0,
    around: SceneFrame | None = None,
    distance: float | None = None,
) -> list[Camera]:
    """Once around the scene at the cameras' median height and distance, beginning at the first camera's side.

    Args:
        cameras: cameras of the scene, at least one; the first one's lens is used.
        frames: pictures, the last a step before the first. swing: up and down by this share of the distance, twice.
        around: the scene's frame; that of the cameras if None.
        distance: of the path from the frame's center, at the same elevation; that of the cameras if None.
    """
    around = around or scene_frame(cameras)
    ahead, side = _level_axes(around, cameras[0].center)
    offsets = torch.stack([camera.center for camera in cameras]) - around.center
    height = float((offsets @ around.up).median())
    level = offsets - (offsets @ around.up)[:, None] * around.up
    radius = max(float(level.norm(dim=1).median()), 1e-6 * around.distance)
    if distance is not None:
        nearer = distance / math.hypot(radius, height)
        radius *= nearer
        height *= nearer
    path = []
    for k in range(frames):
        angle = 2 * math.pi * k / frames
        lift = height + swing * around.distance * math.sin(2 * angle)
        eye = around.center + radius * (math.cos(angle) * ahead + math.sin(angle) * side) + lift * around.up
        rotation, translation = look_at(eye, around.center, around.up)
        path.append(replace(cameras[0], rotation=rotation, translation=translation))
    return path


def interpolated(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path through cameras in their order: cubic splines of place and rotation (SciPy's ``RotationSpline``).

    Cameras that stand in the same place as the one before are left out.
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
    """Level directions from the center toward ``begin`` [3], and a quarter turn from it, counter-clockwise."""
    offset = begin - around.center
    level = offset - dot(offset, around.up) * around.up
    if float(level.norm()) < 1e-6 * around.distance:
        level = -around.panorama_axes()[:, 2]
    ahead = unit(level, 1e-12)
    return ahead, torch.linalg.cross(around.up, ahead)


def camera_record(camera: Camera) -> dict[str, Any]:
    """A camera as the file holds it."""
    return {
        **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "rotation": camera.rotation.flatten().tolist(),
        "translation": camera.translation.tolist(),
    }


class _CameraRecord(msgspec.Struct):
    """A camera as the file holds it."""

    width: Side
    height: Side
    fx: Annotated[float, Meta(gt=0)]
    fy: Annotated[float, Meta(gt=0)]
    cx: float
    cy: float
    rotation: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]
    translation: tuple[float, float, float]


class _PathRecord(msgspec.Struct):
    cameras: Annotated[list[_CameraRecord], Meta(min_length=1, max_length=MOST_FRAMES)]
    frames_per_second: Annotated[float, Meta(gt=0, le=1000)] = 30


def read_path(path: Path) -> tuple[list[Camera], float]:
    """Cameras of a file, and its frames a second (30 if it does not say).

    Raises:
        PolarguideError: no such file, or one that is not as the module says.
    """
    record = read_record(path, _PathRecord, remedy=REMEDY)
    cameras = [_camera_of(camera, f"{path} (cameras[{k}]") for k, camera in enumerate(record.cameras)]
    return cameras, record.frames_per_second


def _camera_of(record: _CameraRecord, where: str) -> Camera:
    lens = f"fx {record.fx:g}, fy {record.fy:g}, cx {record.cx:g}, cy {record.cy:g}"
    size = f"{record.width} x {record.height}"
    place = list(record.translation)
    _require_camera(
        can_be_lens((record.width, record.height), (record.fx, record.fy), (record.cx, record.cy)),
        f"{where})",
        f"numbers up to {FARTHEST:g}, {LENS}",
        f"{lens} for {size} pixels",
    )
    _require_camera(
        max(map(abs, place)) <= FARTHEST, f"{where}.translation)", f"numbers up to {FARTHEST:g}", str(place)
    )
    rotation = torch.tensor(record.rotation, dtype=torch.float64).reshape(3, 3)
    turned = torch.dist(rotation @ rotation.T, torch.eye(3, dtype=torch.float64)) < 1e-3
    _require_camera(
        turned and float(torch.linalg.det(rotation)) > 0,
        f"{where}.rotation)",
        "a rotation",
        str(list(record.rotation)),
    )
    return Camera(
        record.width, record.height, record.fx, record.fy, record.cx, record.cy,
        rotation, torch.tensor(record.translation, dtype=torch.float64),
    )  # fmt: skip


def _require_camera(condition: object, where: str, expected: str, found: str) -> None:
    require(condition, where, expected=expected, found=found, remedy=REMEDY)
