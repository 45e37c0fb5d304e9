"""Points of a model that no camera looks at."""

from __future__ import annotations

import torch

from polarguide.camera import Camera
from polarguide.capture.colmap.model import unseen_points

STILL = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
CAMERA = Camera(24, 20, 30.0, 30.0, 12.0, 10.0, *STILL)


def test_one_point_in_one_picture_is_enough() -> None:
    points = torch.tensor([[0.0, 0.0, -5.0], [0.1, 0.0, 3.0]])
    assert unseen_points(points, [CAMERA]) == []


def test_points_behind_or_far_beside_are_named() -> None:
    for points in ([[0.0, 0.0, -5.0]], [[500.0, 0.0, 1.0]]):
        (warning,) = unseen_points(torch.tensor(points), [CAMERA, CAMERA])
        assert "None of the 1 points" in warning


def test_nothing_is_said_of_nothing() -> None:
    assert unseen_points(torch.zeros(0, 3), [CAMERA]) == unseen_points(torch.ones(1, 3), []) == []
