"""Coverage: the pixels of held-out views whose content a training view shows, on surfaces of known shape."""

import pytest
import torch
from torch import Tensor

from polarguide.geometry.camera import Camera, look_at
from polarguide.results.evaluation.coverage import (
    Coverage,
    DepthMap,
    depth_map_of_rendering,
    depth_map_of_truth,
)

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
