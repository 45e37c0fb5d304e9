"""Coverage of held-out views and surfaces that training views confirm, on surfaces of known shape."""

import pytest
import torch
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.coverage import (
    HAZE_DEPTH,
    ConfirmedSurfaces,
    Coverage,
    DepthMap,
    depth_map_of_rendering,
    depth_map_of_truth,
)
from polarguide.raster import Splats
from polarguide.raster.surface import alpha_in_front

SIZE = 48
WALL = 4.0


def camera(eye, target=(0.0, 0.0, WALL), focal=40.0) -> Camera:
    rotation, translation = look_at(eye, target, (0.0, -1.0, 0.0))
    return Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, rotation, translation)


def plane_depth(view: Camera, distance: float) -> Tensor:
    """Camera depth of the plane z = distance, [H, W]."""
    rays = view.world_rays(dtype=torch.float64)
    along = (distance - view.center[2]) / rays[..., 2]
    return along * view.rays(dtype=torch.float64)[..., 2]


def wall(view: Camera) -> DepthMap:
    return DepthMap(view, plane_depth(view, WALL))


def seen_by(held_out: DepthMap, *training: DepthMap) -> Tensor:
    coverage = Coverage({"view": held_out})
    for view in training:
        coverage.add(view)
    return coverage.seen["view"]


MIDDLE = camera((0.0, 0.0, 0.0))


def test_points_lie_on_the_surface():
    points = wall(camera((0.5, 0.2, 0.1))).points()
    assert torch.allclose(points[..., 2], torch.tensor(WALL, dtype=torch.float64))


def test_background_has_directions_in_place_of_points():
    nothing = DepthMap(MIDDLE, torch.full((SIZE, SIZE), torch.inf, dtype=torch.float64))
    assert torch.allclose(nothing.points(), MIDDLE.world_rays(dtype=torch.float64))


def test_a_view_shows_what_lies_in_its_picture():
    assert seen_by(wall(MIDDLE), wall(MIDDLE)).all()
    assert not seen_by(wall(MIDDLE)).any()
    beside = camera((1.0, 0.0, 0.0), (1.0, 0.0, WALL))
    seen = seen_by(wall(MIDDLE), wall(beside))
    # A shift of 1 at depth 4 and focal length 40 moves the picture by 10 columns.
    assert seen.all(dim=0).sum() == SIZE - 10
    assert not seen[:, seen.all(dim=0).logical_not()].any()


def test_two_views_show_more_than_one():
    left, right = (camera((x, 0.0, 0.0), (x, 0.0, WALL)) for x in (-1.0, 1.0))
    assert seen_by(wall(MIDDLE), wall(left), wall(right)).all()


def test_a_nearer_surface_hides_what_lies_behind_it():
    depth = plane_depth(MIDDLE, WALL)
    depth[16:32, 16:32] = 2.0
    seen = seen_by(wall(MIDDLE), DepthMap(MIDDLE, depth))
    assert not seen[17:31, 17:31].any()
    assert seen[:16].all()


@pytest.mark.parametrize(("factor", "visible"), [(1.01, True), (1.05, False), (0.9, True)])
def test_depths_may_differ_by_the_tolerance(factor, visible):
    behind = DepthMap(MIDDLE, factor * plane_depth(MIDDLE, WALL))
    assert bool(seen_by(behind, wall(MIDDLE)).all()) is visible


def test_background_is_seen_in_its_direction():
    nothing = DepthMap(MIDDLE, torch.full((SIZE, SIZE), torch.inf, dtype=torch.float64))
    moved = camera((3.0, 0.0, 0.0), (3.0, 0.0, WALL))
    assert seen_by(nothing, DepthMap(moved, nothing.depth)).all()
    assert not seen_by(nothing, wall(moved)).any()
    back = camera((0.0, 0.0, 0.0), (0.0, 0.0, -WALL))
    assert not seen_by(nothing, DepthMap(back, nothing.depth)).any()


def test_true_depths_of_zero_are_background():
    depth = torch.zeros(SIZE, SIZE)
    depth[0] = 3
    assert depth_map_of_truth(MIDDLE, depth).depth.isfinite().sum() == SIZE


def test_rendered_depths_are_background_beyond_the_cameras_or_without_alpha():
    depth = plane_depth(MIDDLE, WALL)
    depth[0] = 100.0
    alpha = torch.ones(SIZE, SIZE)
    alpha[1] = 0.4
    middle = torch.tensor([0.0, 0.0, WALL], dtype=torch.float64)
    surface = depth_map_of_rendering(MIDDLE, depth, alpha, middle, radius=4.0).depth.isfinite()
    assert not surface[:2].any()
    assert surface[2:].all()


LEFT, RIGHT = (camera((x, 0.0, 0.0), (x, 0.0, WALL)) for x in (-1.0, 1.0))


def test_two_views_confirm_a_wall():
    nearest = ConfirmedSurfaces([wall(LEFT), wall(RIGHT)]).nearest(MIDDLE)
    # The pictures of both views overlap in 28 columns of depth 4, in the middle of this view.
    torch.testing.assert_close(nearest[:, 10:38], torch.full((SIZE, 28), WALL, dtype=torch.float64))
    assert not nearest[:, :9].any()
    assert not nearest[:, 39:].any()


def test_one_view_confirms_nothing():
    assert not ConfirmedSurfaces([wall(MIDDLE)]).nearest(LEFT).any()
    assert not ConfirmedSurfaces([]).nearest(LEFT).any()
    away = camera((0.0, 0.0, 0.0), (0.0, 0.0, -WALL))
    assert not ConfirmedSurfaces([wall(LEFT), wall(RIGHT)]).nearest(away).any()


def test_a_surface_that_another_view_sees_through_is_not_confirmed():
    depth = plane_depth(MIDDLE, WALL)
    depth[16:32, 16:32] = 2.0
    surfaces = ConfirmedSurfaces([DepthMap(MIDDLE, depth), wall(LEFT), wall(RIGHT)])
    assert float(surfaces.nearest(MIDDLE)[:, 10:38].min()) == pytest.approx(WALL)
    both = ConfirmedSurfaces([DepthMap(MIDDLE, depth), DepthMap(MIDDLE, depth)])
    assert float(both.nearest(MIDDLE)[24, 24]) == pytest.approx(2.0)


def test_the_grid_of_a_large_picture_has_the_same_surfaces():
    large = [view.scaled(10, 10 * SIZE, 10 * SIZE) for view in (LEFT, MIDDLE, RIGHT)]
    assert wall(large[0]).on_grid().depth.shape == (160, 160)
    nearest = ConfirmedSurfaces([wall(view) for view in large]).nearest(large[1])
    assert nearest.shape == (10 * SIZE, 10 * SIZE)
    assert nearest.min() == pytest.approx(WALL)
    assert nearest.max() == pytest.approx(WALL)


@pytest.mark.parametrize("layers", [0, 1, 4])
def test_haze_is_the_alpha_of_fog_in_front_of_a_wall(layers):
    """Each layer of fog is one wide Gaussian of alpha 0.06. A layer behind 0.8 of the depth belongs to the wall."""
    depths = torch.tensor([*torch.linspace(1.0, 2.5, layers).tolist(), 0.9 * WALL])
    count = len(depths)
    fog = Splats(
        torch.stack((torch.zeros(count), torch.zeros(count), depths), dim=1),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count, 3), 1e3),
        torch.full((count,), 0.06),
        torch.ones(count, 1),
    )
    surfaces = ConfirmedSurfaces([wall(view) for view in (LEFT, MIDDLE, RIGHT)])
    by_views = surfaces.nearest(MIDDLE)
    by_truth = plane_depth(MIDDLE, WALL)
    for nearest in (by_views, by_truth):
        alpha = alpha_in_front(fog, MIDDLE, HAZE_DEPTH * nearest, rasterize_reference)
        assert float(alpha[nearest > 0].mean()) == pytest.approx(1 - 0.94**layers, abs=1e-4)


def test_a_surface_of_a_single_view_counts_as_haze():
    """The outer views confirm the wall, and their pictures do not contain the card in front of it."""
    depth = plane_depth(MIDDLE, WALL)
    depth[16:32, 16:32] = 1.0
    nearest = ConfirmedSurfaces([DepthMap(MIDDLE, depth), wall(LEFT), wall(RIGHT)]).nearest(MIDDLE)
    assert float(nearest[:, 10:38].min()) == pytest.approx(WALL)
