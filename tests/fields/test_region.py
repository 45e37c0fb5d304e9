"""The region of a field: coordinates there and back, slopes of its cube, rays through its sphere."""

from __future__ import annotations

from dataclasses import replace

import torch
from textured_ball import DISTANCE, cameras

from polarguide.fields.field import MARGIN, Region

REGION = Region((0.5, -1.0, 2.0), 1.5, 2.6)


def test_it_is_the_cameras_sphere() -> None:
    region = Region.around(cameras(12, 16, 12))
    assert max(abs(x) for x in region.center) < 1e-6
    assert abs(region.unit - DISTANCE / 1.8) < 1e-6  # pictures whose focal length is 0.9 of their width
    assert abs(region.radius * region.unit - MARGIN * DISTANCE) < 1e-6


def test_a_narrow_view_has_a_small_middle_and_a_small_first_sphere() -> None:
    wide = cameras(12, 16, 12)
    narrow = [replace(camera, fx=4 * camera.fx, fy=4 * camera.fy) for camera in wide]
    near, far = Region.around(wide), Region.around(narrow)
    assert abs(4 * far.unit - near.unit) < 1e-6
    assert abs(far.radius - 4 * near.radius) < 1e-4
    assert far.first_radius(1.25) == 1.25
    assert near.first_radius(1.25) == 0.5 * near.radius


def test_there_and_back() -> None:
    places = 5 * torch.randn(100, 3, dtype=torch.float64)
    torch.testing.assert_close(REGION.world(REGION.inner(places)), places)
    inside = places.clamp(-2.6, 2.6)
    cube, _ = REGION.cube(inside)
    assert float(cube.abs().max()) <= 1 + 1e-12
    torch.testing.assert_close(REGION.places(cube), inside)


def test_scales_are_the_derivatives_of_the_cube() -> None:
    places = 2.5 * (2 * torch.rand(100, 3, dtype=torch.float64) - 1)
    _, scale = REGION.cube(places)
    difference = (REGION.cube(places + 1e-6)[0] - REGION.cube(places - 1e-6)[0]) / 2e-6
    torch.testing.assert_close(scale, difference, atol=1e-5, rtol=1e-5)


def test_rays_through_the_sphere() -> None:
    origin = torch.tensor([[0.0, 0, -5], [0, 0, 0], [0, 3, -5]])
    begin, end = REGION.span(origin, torch.tensor([0.0, 0, 1]).expand(3, 3))
    torch.testing.assert_close(begin, torch.tensor([2.4, 0.0, 5.0]))
    torch.testing.assert_close(end, torch.tensor([7.6, 2.6, 5.0]))


def test_what_lies_behind_fills_a_shell() -> None:
    far = torch.tensor([[0.0, 0, 2.6], [0, 0, 1e9], [0.0, -5.2, 0]])
    torch.testing.assert_close(
        REGION.surroundings(far), torch.tensor([[0.0, 0, 0.5], [0, 0, 1.0], [0, -0.75, 0]])
    )
