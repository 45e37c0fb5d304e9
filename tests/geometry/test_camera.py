"""The pose of a camera that looks at a point."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera, look_at, quaternion

EYE, TARGET, UP = (2.0, -1.0, 0.5), (0.2, 0.3, -0.4), (0.1, 0.2, 1.0)


@pytest.mark.parametrize("convert", [tuple, np.array, lambda v: torch.tensor(v, dtype=torch.float64)])
def test_the_target_is_on_the_axis_and_up_is_upward(convert) -> None:  # type: ignore[no-untyped-def]
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, *look_at(convert(EYE), convert(TARGET), convert(UP)))
    torch.testing.assert_close(camera.center, torch.tensor(EYE, dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(camera.rotation @ camera.rotation.T, eye)
    assert float(torch.linalg.det(camera.rotation)) == pytest.approx(1.0)
    x, y, z = camera.rotation @ torch.tensor(TARGET, dtype=torch.float64) + camera.translation
    assert (float(x), float(y)) == pytest.approx((0.0, 0.0), abs=1e-14)
    assert float(z) == pytest.approx(float(np.linalg.norm(np.subtract(TARGET, EYE))))
    right, down, _ = camera.rotation @ torch.tensor(UP, dtype=torch.float64)
    assert float(right) == pytest.approx(0.0, abs=1e-14)
    assert float(down) < 0


def test_a_quaternion_makes_its_rotation_again() -> None:
    rotation, _ = look_at(EYE, TARGET, UP)
    w, x, y, z = quaternion(rotation)
    assert w**2 + x**2 + y**2 + z**2 == pytest.approx(1.0)
    again = quaternions_to_rotations(torch.tensor([w, x, y, z], dtype=torch.float64))
    torch.testing.assert_close(again, rotation)


def test_matrices_project_a_point_like_the_camera() -> None:
    camera = Camera(8, 6, 10.0, 11.0, 4.1, 2.9, *look_at(EYE, TARGET, UP))
    point = torch.tensor([*TARGET, 1.0], dtype=torch.float64)
    x, y, z = camera.intrinsics @ (camera.world_to_camera @ point)[:3]
    assert (float(x / z), float(y / z)) == pytest.approx((4.1, 2.9))
