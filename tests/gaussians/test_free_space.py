"""The empty space before the cameras."""

from __future__ import annotations

import pytest
import torch

from polarguide.gaussians.densify import free_space
from polarguide.geometry.camera import Camera


def camera(z: float) -> Camera:
    """Looks along +z from (0, 0, z)."""
    shift = torch.tensor([0.0, 0.0, -z], dtype=torch.float64)
    return Camera(40, 30, 30.0, 30.0, 20.0, 15.0, torch.eye(3, dtype=torch.float64), shift)


def test_the_radius_is_a_share_of_the_depth_of_the_nearest_points() -> None:
    points = torch.tensor([[0.1, 0.0, 4.0]] * 50 + [[0.0, 0.2, 9.0]] * 50)
    empty = free_space(points, [camera(0.0), camera(2.0)], 0.4, 0.02)
    assert empty.radii.tolist() == pytest.approx([4 * 0.4, 2 * 0.4])
    inside = torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, 2.7], [0.0, 0.0, 3.5], [1.7, 0.0, 0.0]])
    assert empty.contains(inside).tolist() == [True, True, False, False]


def test_one_gross_outlier_among_many_points_does_not_shrink_it() -> None:
    points = torch.tensor([[0.0, 0.0, 4.0]] * 99 + [[0.0, 0.0, 0.01]])
    assert free_space(points, [camera(0.0)], 0.4, 0.02).radii.item() == pytest.approx(4 * 0.4)


def test_a_camera_that_sees_no_point_leaves_nothing_empty() -> None:
    behind_and_beside = torch.tensor([[0.0, 0.0, -1.0], [50.0, 0.0, 1.0]])
    empty = free_space(behind_and_beside, [camera(0.0)], 0.4, 0.02)
    assert empty.radii.tolist() == [0.0]
    assert not empty.contains(torch.zeros(1, 3)).any()
