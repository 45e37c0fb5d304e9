"""Cameras of a browser's window, and paths of keyframes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from random_runs import ring

from polarguide.geometry.camera import quaternion
from polarguide.geometry.trajectory import read_path
from polarguide.viewer.cameras import FRAMES_PER_SECOND, Keyframes, free_camera, letterbox, window_fov

CAMERA = next(iter(ring().values()))


def project(camera, point):
    x, y, z = (camera.rotation @ point + camera.translation).tolist()
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_a_free_camera_takes_the_pose_of_its_quaternion_and_the_fov_from_top_to_bottom():
    camera = free_camera(
        quaternion(CAMERA.rotation.T), CAMERA.center.tolist(), 2 * math.atan(0.5), (300, 200)
    )
    assert torch.allclose(camera.rotation, CAMERA.rotation, atol=1e-9)
    assert torch.allclose(camera.center, CAMERA.center, atol=1e-9)
    ahead, down = CAMERA.rotation[2], CAMERA.rotation[1]
    assert project(camera, camera.center + 3 * ahead) == pytest.approx((150, 100))
    assert project(camera, camera.center + 2 * ahead + down) == pytest.approx((150, 200))


@pytest.mark.parametrize("size", [(640, 480), (1000, 300), (200, 900), (64, 48), (31, 17)])
def test_a_photograph_fits_into_a_window_and_its_camera_with_it(size):
    placement = letterbox(CAMERA, size)
    camera = placement.camera(CAMERA)
    assert (camera.width, camera.height) == size
    corners = np.array([(0, 0), (CAMERA.width, CAMERA.height)])
    inside = corners * placement.scale + (placement.left, placement.top)
    assert (inside >= -1e-9).all()
    assert (inside <= np.array(size) + 1e-9).all()
    assert np.isclose(inside, [(0, 0), size]).all(axis=0).any()  # it touches two borders
    point = CAMERA.center + CAMERA.rotation.T @ torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    before, after = np.array(project(CAMERA, point)), np.array(project(camera, point))
    assert after == pytest.approx(before * placement.scale + (placement.left, placement.top))


@pytest.mark.parametrize("scale", [1, 3])
def test_a_placed_picture_lies_where_the_camera_sees_it(scale):
    size = (scale * CAMERA.width + 20, scale * CAMERA.height)
    picture = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    apply = letterbox(CAMERA, size).apply(picture)
    assert apply.shape == (size[1], size[0], 3)
    middles = apply[scale // 2 :: scale, 10 + scale // 2 : -10 : scale]
    assert np.array_equal(middles, picture)
    assert (apply[:, :9] == 64).all()


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_the_window_holds_the_photograph(aspect):
    fov = window_fov(CAMERA, aspect)
    high, wide = math.tan(fov / 2), aspect * math.tan(fov / 2)
    assert high >= CAMERA.height / 2 / CAMERA.fy - 1e-9
    assert wide >= CAMERA.width / 2 / CAMERA.fx - 1e-9
    assert min(high - CAMERA.height / 2 / CAMERA.fy, wide - CAMERA.width / 2 / CAMERA.fx) < 1e-9


def test_a_path_goes_through_its_poses(tmp_path):
    keyframes, poses = Keyframes((80, 50)), list(ring().values())[:3]
    for camera in poses:
        keyframes.add(camera)
    file = tmp_path / "path.json"
    file.write_text(keyframes.to_json(1.5))
    cameras, speed = read_path(file)
    step = round(1.5 * FRAMES_PER_SECOND)
    assert (speed, len(cameras)) == (FRAMES_PER_SECOND, 1 + 2 * step)
    assert {(c.width, c.height) for c in cameras} == {(80, 50)}
    for pose, camera in zip(poses, cameras[::step], strict=True):
        assert torch.allclose(camera.center, pose.center, atol=1e-9)
        assert torch.allclose(camera.rotation, pose.rotation, atol=1e-9)
        # The same from top to bottom.
        assert camera.height / camera.fy == pytest.approx(pose.height / pose.fy)


def test_one_pose_is_a_path_of_one_and_none_is_none():
    keyframes = Keyframes((80, 50))
    assert keyframes.path(2.0) == []
    keyframes.add(ring()["v0"])
    assert len(keyframes.path(2.0)) == 1
