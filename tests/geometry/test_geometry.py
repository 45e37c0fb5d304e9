"""Where cameras stand, and paths of cameras."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault
from torch import Tensor

from polarguide import optics
from polarguide.capture import view
from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera, look_at, quaternion
from polarguide.geometry.camera_path import camera_record, interpolated, orbit, read_path
from polarguide.geometry.polarizer import ANGLES, four_intensities, malus, stokes_of_four
from polarguide.geometry.scene_frame import scene_frame

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
    assert angle_between(scene_frame(cameras).up, UP) < 0.1
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
    ("change", "where", "expected"),
    [
        ({"width": 0}, ".width)", "1 to 8192"),
        ({"width": 10**6}, ".width)", "1 to 8192"),
        ({"height": "tall"}, ".height)", "a whole number"),
        ({"fx": -1.0}, ".fx)", "above 0"),
        ({"fx": float("nan")}, ".fx)", "above 0"),
        ({"rotation": [0.0] * 9}, ".rotation)", "a rotation"),
        ({"rotation": [1.0, 0, 0, 0, 1, 0, 0, 0, -1]}, ".rotation)", "a rotation"),
        ({"rotation": [1.0]}, ".rotation)", "length >= 9"),
        ({"translation": [1.0, 2.0]}, ".translation)", "length 3"),
        ({"translation": None}, ".translation)", "a list"),
        ({"fx": 1e-30, "fy": 1e-30}, ")", "positive focal lengths"),
        ({"fx": 1e-2}, ")", "positive focal lengths"),
        ({"cx": 1e300}, ")", "a principal point"),
        ({"translation": [1e38, 0.0, 0.0]}, ".translation)", "up to 1e+09"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(
    change: dict[str, object], where: str, expected: str, tmp_path: Path
) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": [camera_record(LENS), camera_record(LENS) | change]}))
    Fault(f"path.json (cameras[1]{where}", expected, "", "orbit, spiral").raised_by(read_path, file)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"cameras": []}', '{"cameras": 3}', "[" * 100_000])
def test_files_without_cameras_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(text)
    for name in ("path.json", "none.json"):
        Fault(name, remedy="orbit, spiral").raised_by(read_path, tmp_path / name)


PLACE, TARGET, UPWARD = (2.0, -1.0, 0.5), (0.2, 0.3, -0.4), (0.1, 0.2, 1.0)


@pytest.mark.parametrize("convert", [tuple, np.array, lambda v: torch.tensor(v, dtype=torch.float64)])
def test_the_target_is_on_the_axis_and_up_is_upward(convert) -> None:  # type: ignore[no-untyped-def]
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, *look_at(convert(PLACE), convert(TARGET), convert(UPWARD)))
    torch.testing.assert_close(camera.center, torch.tensor(PLACE, dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(camera.rotation @ camera.rotation.T, eye)
    assert float(torch.linalg.det(camera.rotation)) == pytest.approx(1.0)
    x, y, z = camera.rotation @ torch.tensor(TARGET, dtype=torch.float64) + camera.translation
    assert (float(x), float(y)) == pytest.approx((0.0, 0.0), abs=1e-14)
    assert float(z) == pytest.approx(float(np.linalg.norm(np.subtract(TARGET, PLACE))))
    right, down, _ = camera.rotation @ torch.tensor(UPWARD, dtype=torch.float64)
    assert float(right) == pytest.approx(0.0, abs=1e-14)
    assert float(down) < 0


def test_a_quaternion_makes_its_rotation_again() -> None:
    rotation, _ = look_at(PLACE, TARGET, UPWARD)
    w, x, y, z = quaternion(rotation)
    assert w**2 + x**2 + y**2 + z**2 == pytest.approx(1.0)
    again = quaternions_to_rotations(torch.tensor([w, x, y, z], dtype=torch.float64))
    torch.testing.assert_close(again, rotation)


def test_matrices_project_a_point_like_the_camera() -> None:
    camera = Camera(8, 6, 10.0, 11.0, 4.1, 2.9, *look_at(PLACE, TARGET, UPWARD))
    point = torch.tensor([*TARGET, 1.0], dtype=torch.float64)
    x, y, z = camera.intrinsics @ (camera.world_to_camera @ point)[:3]
    assert (float(x / z), float(y / z)) == pytest.approx((4.1, 2.9))


LIGHT = np.random.default_rng(0).uniform(0.1, 1.0, (3, 4, 5))


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 2, -1.1])
def test_arrays_and_tensors_give_the_same(angle: float) -> None:
    s0, s1, s2 = LIGHT
    expected = s0 / 2 + np.hypot(s1, s2) / 2 * np.cos(np.arctan2(s2, s1) - 2 * angle)
    assert np.allclose(malus(LIGHT, angle), expected, rtol=0, atol=1e-15)
    tensor = malus(torch.from_numpy(LIGHT), torch.tensor(angle, dtype=torch.float64))
    assert np.allclose(tensor.numpy(), expected, rtol=0, atol=1e-15)


def test_an_angle_for_each_pixel() -> None:
    angles = np.radians(np.resize(ANGLES, (4, 5)))
    assert malus(LIGHT, angles)[1, 2] == pytest.approx(malus(LIGHT[:, 1, 2], angles[1, 2]))


def test_the_angle_has_a_gradient() -> None:
    angle = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    malus(torch.tensor([1.0, 0.3, 0.2], dtype=torch.float64), angle).backward()
    assert float(angle.grad) == pytest.approx(-0.3 * math.sin(0.8) + 0.2 * math.cos(0.8))


def test_the_four_angles_are_the_law_and_invert() -> None:
    four = np.stack(four_intensities(LIGHT))
    assert np.allclose(four, [malus(LIGHT, math.radians(angle)) for angle in ANGLES], rtol=0, atol=1e-15)
    assert np.allclose(np.stack(stokes_of_four(four)), LIGHT, rtol=0, atol=1e-15)


def test_the_angles_are_one_object() -> None:
    assert optics.ANGLES is ANGLES
    assert view.ANGLES is ANGLES
