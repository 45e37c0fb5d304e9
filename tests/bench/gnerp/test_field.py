"""Rays, grids and the region of a field: against loops over points, and gradients against differences."""

import math
from dataclasses import replace

import pytest
import torch
from small_fields import SMALL_SAMPLING, SMALL_SHAPE
from textured_ball import DISTANCE, cameras
from torch.autograd import gradcheck

from polarguide_bench.gnerp.field import MARGIN, Field, Region
from polarguide_bench.gnerp.grids import (
    FeatureGrids,
    SmoothGrids,
    linear_weights,
    spline_matrix,
    spline_weights,
)
from polarguide_bench.gnerp.march import march, section_opacity, trace
from polarguide_bench.gnerp.recipe import FieldShape, Sampling

REGION = Region((0.0, 0.0, 0.0), 1.0, 2.5)
RADIUS = 0.5 * REGION.radius
FINE = Sampling(coarse=64, fine=64, background=4)


def grid_field(spread: float = 0.01) -> Field:
    shape = FieldShape(resolutions=(8, 16), channels=2, width=16, background=(8,), first_spread=spread)
    return Field(REGION, shape, torch.Generator().manual_seed(3))


def rays(offsets: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays along z that pass the origin at these distances."""
    origin = torch.stack((offsets, torch.zeros_like(offsets), torch.full_like(offsets, -2.4)), dim=1)
    return origin, torch.tensor([0.0, 0, 1]).expand(len(offsets), 3)


def test_rays_meet_the_sphere_where_it_is() -> None:
    offsets = torch.tensor([0.0, 0.5, 1.0])
    origin, direction = rays(offsets)
    wanted = 2.4 - (RADIUS**2 - offsets**2).sqrt()
    with torch.no_grad():
        seen = march(grid_field(), origin, direction, FINE)
        traced, hit = trace(grid_field(), origin, direction)
    assert bool(hit.all())
    torch.testing.assert_close(traced, wanted, atol=2e-3, rtol=0)
    torch.testing.assert_close(seen.distance, wanted, atol=0.03, rtol=0)
    assert float(seen.opacity.min()) > 0.99
    normal = (origin + wanted[:, None] * direction) / RADIUS
    torch.testing.assert_close(seen.normal, normal, atol=0.05, rtol=0)


def test_rays_beside_it_see_what_lies_behind() -> None:
    origin, direction = rays(torch.tensor([1.6, 2.2]))
    with torch.no_grad():
        seen = march(grid_field(), origin, direction, FINE)
        _, hit = trace(grid_field(), origin, direction)
    assert not bool(hit.any())
    assert float(seen.opacity.max()) < 1e-3
    assert float(seen.color.min()) > 0.1


def test_weights_against_a_loop() -> None:
    """Sections end halfway between samples; opacity is the drop of the logistic function of s f over a section."""
    field = grid_field(0.05)
    origin, direction = rays(torch.tensor([0.3, 1.2]))
    with torch.no_grad():
        seen = march(field, origin, direction, SMALL_SAMPLING)
    s, longest = float(field.sharpness.detach()), 1e9
    for n in range(2):
        begin, end = (float(t[n]) for t in REGION.span(origin, direction))
        longest = (end - begin) / SMALL_SAMPLING.coarse
        along = seen.along[n].tolist()
        through = 1.0
        for k, at in enumerate(along):
            place = origin[n] + at * direction[n]
            distance = float(place.norm()) - RADIUS
            falling = min(0.0, float(direction[n] @ place / place.norm()))
            before = (along[k - 1] + at) / 2 if k else begin
            after = (along[k + 1] + at) / 2 if k + 1 < len(along) else end
            first = 1 / (1 + math.exp(-s * (distance + falling * max(before - at, -longest))))
            last = 1 / (1 + math.exp(-s * (distance + falling * min(after - at, longest))))
            alpha = max(0.0, (first - last) / (first + 1e-5))
            assert float(seen.weights[n, k]) == pytest.approx(through * alpha, abs=1e-4)
            through *= 1 - alpha


def test_opacity_of_a_section() -> None:
    entering, leaving = torch.tensor([5.0, -5.0, 0.0]), torch.tensor([-5.0, 5.0, 0.0])
    found = section_opacity(entering, leaving)
    torch.testing.assert_close(found, torch.tensor([0.9932, 0.0, 0.0]), atol=1e-3, rtol=0)


def test_the_map_has_the_distances() -> None:
    field = grid_field()
    with torch.no_grad():
        for table in field.shape_grids.levels:  # type: ignore[union-attr]
            table.copy_(0.05 * torch.randn(table.shape, generator=torch.Generator().manual_seed(4)))
        field.map_distances()
        places = 2.4 * (2 * torch.rand(200, 3) - 1)
        exact = field.geometry(places).distance
        torch.testing.assert_close(field.near_distance(places), exact, atol=0.02, rtol=0)
        axes = tuple(torch.linspace(-2, 2, n) for n in (3, 4, 5))
        lattice = field.lattice(axes)
        corner = torch.stack([axis[-1] for axis in axes])[None]
        assert float(lattice[-1, -1, -1]) == pytest.approx(float(field.geometry(corner).distance), abs=1e-5)


def test_a_shape_of_its_own_is_kept_small() -> None:
    assert (
        sum(values.numel() for values in Field(REGION, SMALL_SHAPE, torch.Generator()).parameters()) < 30_000
    )


GENERATOR = torch.Generator().manual_seed(1)


def some_places(count: int = 50) -> torch.Tensor:
    return 2 * torch.rand(count, 3, generator=GENERATOR, dtype=torch.float64) - 1


def filled(resolutions: tuple[int, ...]) -> SmoothGrids:
    grids = SmoothGrids(resolutions).double()
    with torch.no_grad():
        for table in grids.levels:
            table.copy_(torch.randn(table.shape, generator=GENERATOR, dtype=torch.float64))
    return grids


@pytest.mark.parametrize("resolution", [1, 4, 7])
def test_weights_of_values_add_up_to_one_and_those_of_slopes_to_none(resolution: int) -> None:
    _, weights = spline_weights(some_places(), resolution)
    sums = weights.sum(dim=2)
    torch.testing.assert_close(
        sums, torch.tensor([1.0, 0, 0, 0]).double().expand_as(sums), atol=1e-12, rtol=0
    )
    _, linear = linear_weights(some_places(), resolution)
    torch.testing.assert_close(linear.sum(dim=1), torch.ones(50).double())
    assert float(linear.min()) >= 0


def test_a_spline_has_the_slope_of_a_plane() -> None:
    """Nodes on a plane give the plane: they lie in the middles of the cells and one cell beyond."""
    side = 6
    at = (torch.arange(side + 2, dtype=torch.float64) - 0.5) * 2 / side - 1
    x, y, z = torch.meshgrid(at, at, at, indexing="ij")
    grids = SmoothGrids((side,)).double()
    with torch.no_grad():
        grids.levels[0].copy_((0.3 * x - 2 * y + 0.5 * z + 1).reshape(-1, 1))
    places = some_places()
    value, slope = grids(places)
    torch.testing.assert_close(value, places @ torch.tensor([0.3, -2, 0.5]).double() + 1)
    torch.testing.assert_close(slope, torch.tensor([0.3, -2, 0.5]).double().expand(50, 3))


def test_slopes_are_the_derivatives_of_values() -> None:
    grids, places, step = filled((3, 5)), 0.9 * some_places(), 1e-6
    _, slope = grids(places)
    for axis in range(3):
        away = torch.zeros(3, dtype=torch.float64)
        away[axis] = step
        difference = (grids(places + away)[0] - grids(places - away)[0]) / (2 * step)
        torch.testing.assert_close(slope[:, axis], difference, atol=1e-6, rtol=1e-5)


def test_slopes_do_not_jump_between_cells() -> None:
    grids = filled((4,))
    border = torch.zeros(1, 3, dtype=torch.float64)  # where eight cells meet
    before, after = (grids(border + shift)[1] for shift in (-1e-9, 1e-9))
    torch.testing.assert_close(before, after, atol=1e-6, rtol=0)


def test_gradients_of_values_and_slopes_are_those_of_finite_differences() -> None:
    places = some_places(5)
    grids = filled((2, 3))

    def both(*tables: torch.Tensor) -> torch.Tensor:
        value, slope = torch.func.functional_call(
            grids, {f"levels.{k}": table for k, table in enumerate(tables)}, (places,)
        )
        return value.square() + slope.norm(dim=1)

    tables = [table.detach().requires_grad_() for table in grids.levels]
    assert gradcheck(both, tables, check_batched_grad=False)


def test_gradients_of_features_are_those_of_finite_differences() -> None:
    grids = FeatureGrids((2,), 2, 0.1, GENERATOR).double()
    places = some_places(6)

    def features(table: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = torch.func.functional_call(grids, {"levels.0": table}, (places,))
        return found.square()

    assert gradcheck(features, [grids.levels[0].detach().requires_grad_()], check_batched_grad=False)


def test_features_at_nodes_are_the_nodes() -> None:
    grids = FeatureGrids((4,), 3, 0.1, GENERATOR).double()
    node = torch.tensor([[0.5, -1.0, 1.0]], dtype=torch.float64)  # numbers 3, 0 and 4 along the axes
    torch.testing.assert_close(grids(node)[0], grids.levels[0].detach()[(3 * 5 + 0) * 5 + 4])


def test_outside_counts_as_the_surface_of_the_cube() -> None:
    grids = filled((4,))
    beyond = torch.tensor([[1.5, 0.2, -3.0]], dtype=torch.float64)
    torch.testing.assert_close(grids(beyond), grids(beyond.clamp(-1, 1)))


def test_a_matrix_has_the_weights_along_an_axis() -> None:
    axis, table = torch.linspace(-1, 1, 9, dtype=torch.float64), torch.randn(7, dtype=torch.float64)
    wanted = spline_weights(torch.stack((axis, 0 * axis, 0 * axis), dim=1), 5)
    nodes, weights = wanted[0] // 49, wanted[1][:, 0]
    torch.testing.assert_close(spline_matrix(axis, 5) @ table, (weights * table[nodes]).sum(dim=1))


SHELL = Region((0.5, -1.0, 2.0), 1.5, 2.6)


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
    torch.testing.assert_close(SHELL.inner(places) * SHELL.unit + places.new_tensor(SHELL.center), places)
    inside = places.clamp(-2.6, 2.6)
    cube, _ = SHELL.cube(inside)
    assert float(cube.abs().max()) <= 1 + 1e-12
    torch.testing.assert_close(SHELL.places(cube), inside)


def test_scales_are_the_derivatives_of_the_cube() -> None:
    places = 2.5 * (2 * torch.rand(100, 3, dtype=torch.float64) - 1)
    _, scale = SHELL.cube(places)
    difference = (SHELL.cube(places + 1e-6)[0] - SHELL.cube(places - 1e-6)[0]) / 2e-6
    torch.testing.assert_close(scale, difference, atol=1e-5, rtol=1e-5)


def test_rays_through_the_sphere() -> None:
    origin = torch.tensor([[0.0, 0, -5], [0, 0, 0], [0, 3, -5]])
    begin, end = SHELL.span(origin, torch.tensor([0.0, 0, 1]).expand(3, 3))
    torch.testing.assert_close(begin, torch.tensor([2.4, 0.0, 5.0]))
    torch.testing.assert_close(end, torch.tensor([7.6, 2.6, 5.0]))


def test_what_lies_behind_fills_a_shell() -> None:
    far = torch.tensor([[0.0, 0, 2.6], [0, 0, 1e9], [0.0, -5.2, 0]])
    torch.testing.assert_close(
        SHELL.surroundings(far), torch.tensor([[0.0, 0, 0.5], [0, 0, 1.0], [0, -0.75, 0]])
    )
