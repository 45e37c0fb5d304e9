"""Where cameras stand, and paths of cameras."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.scene_frame import scene_frame
from polarguide.geometry.trajectory import camera_record, interpolated, orbit, read_path

EYE = torch.eye(3, dtype=torch.float64)
LENS = Camera(64, 48, 70.0, 70.0, 32.0, 24.0, EYE, EYE[0])
UP = torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64) / math.sqrt(1.05)
CENTER = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def around(count: int = 8, distance: float = 4.0) -> list[Camera]:
    side = torch.linalg.cross(UP, EYE[0])
    side = side / side.norm()
    ahead = torch.linalg.cross(side, UP)
    cameras = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        way = math.cos(angle) * ahead + math.sin(angle) * side + 0.3 * UP
        rotation, translation = look_at(CENTER + distance * way / way.norm(), CENTER, UP)
        cameras.append(replace(LENS, rotation=rotation, translation=translation))
    return cameras


def test_the_frame_of_cameras_around_a_point() -> None:
    frame = scene_frame(around())
    torch.testing.assert_close(frame.center, CENTER)
    torch.testing.assert_close(frame.up, UP, atol=1e-6, rtol=0)
    assert frame.distance == pytest.approx(4.0)


def test_up_is_level_s_normal_though_all_cameras_look_down_from_one_side() -> None:
    """Their pictures' upward directions lean away from the side that they stand on."""
    cameras = []
    for degrees in range(-40, 41, 10):
        turn = scene_frame(around()).turn(degrees)
        side = turn @ torch.linalg.cross(UP, torch.tensor([0.0, 0, 1], dtype=torch.float64))
        rotation, translation = look_at(CENTER + 4 * (side + UP), CENTER, UP)
        cameras.append(replace(LENS, rotation=rotation, translation=translation))
    found = scene_frame(cameras).up
    assert angle_between(found, UP) < 0.1
    mean = -torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0)
    assert angle_between(mean, UP) > 30
    on_end = [
        replace(
            c, rotation=torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64) @ c.rotation
        )
        for c in cameras
    ]
    mean = -torch.stack([camera.rotation[1] for camera in on_end]).mean(dim=0)
    assert angle_between(scene_frame(on_end).up, mean) < 1e-3, "held on end, the rows do not tell"


def test_one_camera_and_parallel_ones_have_a_frame() -> None:
    for cameras in (
        [LENS],
        [LENS, replace(LENS, translation=torch.tensor([5.0, 0, 0], dtype=torch.float64))],
    ):
        frame = scene_frame(cameras)
        assert bool(torch.isfinite(frame.center).all())
        assert frame.distance > 0
        assert float((frame.center - cameras[0].center) @ cameras[0].rotation[2]) > 0


def test_turning_is_counter_clockwise_seen_from_above() -> None:
    frame = scene_frame(around())
    axes = frame.panorama_axes()
    right, up, back = axes.unbind(1)
    torch.testing.assert_close(axes @ axes.T, EYE, atol=1e-9, rtol=0)
    assert float(torch.linalg.det(axes)) == pytest.approx(1)
    torch.testing.assert_close(up, frame.up)
    torch.testing.assert_close(frame.turn(90) @ -back, -right)  # ahead turns to the left
    torch.testing.assert_close(frame.turn(30) @ frame.turn(-30), EYE)


def angle_between(a: Tensor, b: Tensor) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, float(a @ b / (a.norm() * b.norm()))))))


@pytest.mark.parametrize("swing", [0.0, 0.25])
def test_paths_around_look_at_the_center_upright(swing: float) -> None:
    cameras = orbit(around(), 16, swing=swing)
    assert len(cameras) == 16
    for camera in cameras:
        assert angle_between(CENTER - camera.center, camera.rotation[2]) < 1e-5
        assert angle_between(-camera.rotation[1], UP) < 60
        assert abs(float(camera.rotation[0] @ UP)) < 1e-6  # no roll
        assert float(torch.linalg.det(camera.rotation)) == pytest.approx(1)
    if not swing:
        torch.testing.assert_close(cameras[0].center, around()[0].center)
        steps = torch.stack([camera.center for camera in cameras])
        gaps = (steps - steps.roll(1, 0)).norm(dim=1)
        torch.testing.assert_close(gaps, gaps[:1].expand(16))


def test_interpolation_passes_through_the_cameras() -> None:
    cameras = around(5)
    path = interpolated(cameras, 41)
    for k, camera in enumerate(cameras):
        torch.testing.assert_close(path[10 * k].center, camera.center, atol=1e-9, rtol=0)
        torch.testing.assert_close(path[10 * k].rotation, camera.rotation, atol=1e-6, rtol=0)
    assert len(interpolated([LENS, LENS], 3)) == 3


def test_a_file_of_cameras_is_read_back(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    cameras = around(3)
    file.write_text(json.dumps({"cameras": [camera_record(c) for c in cameras], "frames_per_second": 24}))
    read, speed = read_path(file)
    assert speed == 24
    for a, b in zip(read, cameras, strict=True):
        assert (a.width, a.height, a.fx, a.cy) == (b.width, b.height, b.fx, b.cy)
        torch.testing.assert_close(a.center, b.center)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"width": 10**6},
        {"height": "tall"},
        {"fx": -1.0},
        {"fx": float("nan")},
        {"rotation": [0.0] * 9},
        {"rotation": [1.0, 0, 0, 0, 1, 0, 0, 0, -1]},
        {"rotation": [1.0]},
        {"translation": [1.0, 2.0]},
        {"translation": None},
    ],
)
def test_cameras_that_are_none_are_refused(change: dict[str, object], tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": [camera_record(LENS) | change]}))
    (field,) = change
    with pytest.raises(PolarguideError, match=rf"path.json \(cameras\[0\]\.?{field}.*Give orbit, spiral"):
        read_path(file)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": 1e-30, "fy": 1e-30}, "positive focal lengths"),
        ({"fx": 1e-2}, "positive focal lengths"),
        ({"cx": 1e300}, "a principal point"),
        ({"translation": [1e38, 0.0, 0.0]}, r"\.translation\): expected numbers up to 1e\+09"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(change: dict[str, object], says: str, tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": [camera_record(LENS), camera_record(LENS) | change]}))
    with pytest.raises(PolarguideError, match=rf"path.json \(cameras\[1\].*{says}.*Give orbit, spiral"):
        read_path(file)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"cameras": []}', '{"cameras": 3}', "[" * 100_000])
def test_files_without_cameras_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(text)
    for name in ("path.json", "none.json"):
        with pytest.raises(PolarguideError, match=rf"{name}.*Give orbit, spiral"):
            read_path(tmp_path / name)
