"""The Gaussians to begin with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from polarguide.gaussians.densify import free_space
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.initialize import (
    Initialization,
    far_away,
    initial_parameters,
    neighbor_distance,
    scene_extent,
    stretch_steps,
)
from polarguide.geometry.camera import Camera

SETTINGS = Initialization(shell=40, shell_radii=(3.0, 12.0), opacity=0.2)


def capture() -> tuple[Tensor, Tensor, Tensor]:
    """Points, their colors, and camera centers on a circle of radius 4."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(30, 3, generator=generator)
    colors = torch.rand(30, 3, generator=generator)
    angles = torch.linspace(0, 6, 9)
    centers = torch.stack((4 * torch.cos(angles), torch.zeros(9), 4 * torch.sin(angles)), dim=1)
    return points, colors, centers


def test_rows_have_the_shapes_of_the_core_and_are_finite() -> None:
    rows = initial_parameters(*capture(), SETTINGS, seed=0)
    assert {name: tuple(t.shape[1:]) for name, t in rows.items()} == CORE_SHAPES
    for tensor in rows.values():
        assert tensor.shape[0] == 30 + 40
        assert tensor.dtype == torch.float32
        assert bool(torch.isfinite(tensor).all())


def test_points_keep_their_place_and_color_and_all_have_the_first_opacity() -> None:
    points, colors, centers = capture()
    rows = initial_parameters(points, colors, centers, SETTINGS, seed=0)
    torch.testing.assert_close(rows["means"][:30], points)
    torch.testing.assert_close(SH_C0 * rows["sh_dc"][:30] + 0.5, colors)
    assert not rows["sh_rest"].any()
    torch.testing.assert_close(torch.sigmoid(rows["opacity_logits"]), torch.full((70,), 0.2))


def test_round_at_first_and_as_wide_as_the_spacing() -> None:
    points, colors, centers = capture()
    scales = initial_parameters(points, colors, centers, SETTINGS, seed=0)["log_scales"].exp()
    assert torch.equal(scales[:, 0], scales[:, 1])
    assert torch.equal(scales[:, 0], scales[:, 2])
    distance = torch.cdist(points.double(), points.double()).sort(dim=1).values[:, 1:4]
    torch.testing.assert_close(scales[:30, 0], distance.square().mean(dim=1).sqrt().float())


def test_added_ones_lie_in_the_shell() -> None:
    points, colors, centers = capture()
    rows = initial_parameters(points, colors, centers, SETTINGS, seed=0)
    middle = torch.tensor(np.median(points.numpy(), axis=0))
    radius = float((centers - middle).norm(dim=1).quantile(0.9))
    distance = (rows["means"][30:] - middle).norm(dim=1) / radius
    assert 2.99 < float(distance.min()) < float(distance.max()) < 12.01
    assert float(rows["log_scales"][30:].mean()) > float(rows["log_scales"][:30].mean())


def test_steps_beyond_the_cameras_grow_with_distance() -> None:
    middle = torch.tensor([1.0, 0.0, 0.0])
    before = middle + torch.tensor([[0.5, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 80.0]])
    step = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]])
    means = before + step
    stretch_steps(means, before, middle, 2.0)
    torch.testing.assert_close(means[:2], (before + step)[:2])
    torch.testing.assert_close(means[2] - before[2], 40 * step[2], rtol=1e-4, atol=1e-4)


def test_none_are_added_if_none_are_asked_for() -> None:
    assert len(initial_parameters(*capture(), replace(SETTINGS, shell=0), seed=0)["means"]) == 30


def test_the_seed_decides() -> None:
    first, again, other = (initial_parameters(*capture(), SETTINGS, seed=seed) for seed in (0, 0, 1))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["means"], other["means"])


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_points_have_a_spacing(count: int) -> None:
    points = np.arange(3.0 * count).reshape(count, 3)
    spacing = neighbor_distance(points)
    assert spacing.shape == (count,)
    assert (spacing > 0).all()


def test_points_at_one_place_have_a_positive_spacing() -> None:
    assert (neighbor_distance(np.zeros((8, 3))) > 0).all()


def test_the_extent_is_a_tenth_more_than_the_farthest_camera() -> None:
    centers = torch.tensor([[0.0, 0, 0], [4.0, 0, 0], [2.0, 3.0, 0], [2.0, -3.0, 0]])
    assert scene_extent(centers) == pytest.approx(3.3)


def test_far_away_is_what_lies_beyond_the_cameras() -> None:
    points, colors, centers = capture()
    middle = points.median(dim=0).values
    places = middle + torch.tensor([[0.0, 3.0, 0.0], [0.0, 0.0, -6.0], [5.5, 0.0, 0.0]])
    assert far_away(places, points, centers).tolist() == [False, True, True]
    assert far_away(places, points, centers, 0.5).tolist() == [True, True, True]
    assert far_away((places - middle) / 4 + middle, points, centers, 0.5).tolist() == [False, False, False]
    rows = initial_parameters(points, colors, centers, SETTINGS, seed=0)
    assert far_away(rows["means"], points, centers).tolist() == [False] * 30 + [True] * 40


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
