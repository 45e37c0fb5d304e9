"""Grids: what they interpolate exactly, slopes against differences, gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import gradcheck

from polarguide.fields.grids import FeatureGrids, SmoothGrids, linear_weights, spline_matrix, spline_weights

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
