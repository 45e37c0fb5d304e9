"""Dense grids over a cube, one a resolution, whose interpolated values are linear in what they learn.

Value and slope of a grid at a point are weighted sums of the same few nodes, so that a loss on slopes (on normals)
reaches the nodes without differentiating anything twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn


class _Gather(torch.autograd.Function):
    """``out[n, q, c] = sum over k of weights[n, q, k] table[nodes[n, k], c]``; a gradient goes to the table alone."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, nodes: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(nodes, weights)
        ctx.shape = table.shape
        return torch.bmm(weights, table.index_select(0, nodes.flatten()).view(*nodes.shape, table.shape[1]))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        nodes, weights = ctx.saved_tensors
        spread = torch.bmm(weights.transpose(1, 2), grad)
        table = grad.new_zeros(ctx.shape)
        if ctx.shape[1] == 1:  # far faster on the CPU than rows of one
            table.view(-1).scatter_add_(0, nodes.flatten(), spread.flatten())
        else:
            table.index_add_(0, nodes.flatten(), spread.view(-1, ctx.shape[1]))
        return table, None, None


class SmoothGrids(nn.Module):
    """A scalar as a sum of quadratic B-splines on several grids: once continuously differentiable.

    Args:
        resolutions: cells along a side of the cube [-1, 1]^3, one grid each. All start at zero.
    """

    def __init__(self, resolutions: Sequence[int]) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        self.levels = nn.ParameterList(torch.zeros((n + 2) ** 3, 1) for n in resolutions)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Values [N] and slopes [N, 3] at places [N, 3]; what lies outside the cube counts as on its surface."""
        sums = torch.zeros(len(places), 4, 1, dtype=places.dtype, device=places.device)
        for resolution, table in zip(self.resolutions, self.levels, strict=True):
            nodes, weights = spline_weights(places, resolution)
            sums = sums + _Gather.apply(table, nodes, weights)
        return sums[:, 0, 0], sums[:, 1:, 0]


class FeatureGrids(nn.Module):
    """Features as trilinear interpolations on several grids, side by side.

    Args:
        resolutions: cells along a side of the cube [-1, 1]^3, one grid each.
        channels: channels of each. spread: half-width of the uniform first values.
        generator: they are drawn from.
    """

    def __init__(
        self, resolutions: Sequence[int], channels: int, spread: float, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        first = (torch.rand((n + 1) ** 3, channels, generator=generator) for n in resolutions)
        self.levels = nn.ParameterList((2 * values - 1) * spread for values in first)
        self.width = channels * len(self.resolutions)

    def forward(self, places: Tensor) -> Tensor:
        """Features [N, width] at places [N, 3]; what lies outside the cube counts as on its surface."""
        features = []
        for resolution, table in zip(self.resolutions, self.levels, strict=True):
            nodes, weights = linear_weights(places, resolution)
            features.append(_Gather.apply(table, nodes, weights[:, None])[:, 0])
        return torch.cat(features, dim=1)


def spline_weights(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """The 27 nodes [N, 27] around each place [N, 3], and their weights [N, 4, 27] in the value and the three slopes.

    Along an axis, a place t in [0, 1] of the way through its cell has the weights (1 - t)^2 / 2, 1/2 + t - t^2 and
    t^2 / 2 of the cell before it, its own and the next one. A grid has a layer of nodes around the cube for that.
    """
    cell, t = _cell(places, resolution)
    nodes = _nodes(cell, resolution + 2, 3)
    weight = _quadratic(t)
    slope = torch.stack((t - 1, 1 - 2 * t, t), dim=-1) * (0.5 * resolution)
    wx, wy, wz = weight.unbind(1)
    sx, sy, sz = slope.unbind(1)
    across = _outer(wy, wz)
    along_y = _outer(sy, wz)
    along_z = _outer(wy, sz)
    rows = (_outer(wx, across), _outer(sx, across), _outer(wx, along_y), _outer(wx, along_z))
    return nodes, torch.stack(rows, dim=1)


def spline_matrix(axis: Tensor, resolution: int) -> Tensor:
    """Weights [M, resolution + 2] of a grid's nodes along one axis, at places [M] on it."""
    cell, t = _cell(axis, resolution)
    nodes = cell.long()[:, None] + torch.arange(3, device=axis.device)
    return axis.new_zeros(len(axis), resolution + 2).scatter_(1, nodes, _quadratic(t))


def linear_weights(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """The 8 nodes [N, 8] around each place [N, 3], and their weights [N, 8]."""
    cell, t = _cell(places, resolution)
    wx, wy, wz = torch.stack((1 - t, t), dim=-1).unbind(1)
    return _nodes(cell, resolution + 1, 2), _outer(wx, _outer(wy, wz))


def _quadratic(t: Tensor) -> Tensor:
    """Weights [..., 3] of a quadratic B-spline at t [...] of the way through a cell."""
    return torch.stack((0.5 * (1 - t) ** 2, 0.5 + t - t * t, 0.5 * t * t), dim=-1)


def _cell(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Cell [...] of each place along an axis, a whole number, and how far through it the place is, in [0, 1]."""
    scaled = (0.5 * resolution) * (places.clamp(-1, 1) + 1)
    cell = scaled.floor().clamp(max=resolution - 1)
    return cell, scaled - cell


def _nodes(cell: Tensor, side: int, reach: int) -> Tensor:
    """Numbers of the nodes from each cell on, ``reach`` along each axis, in a grid with ``side`` of them."""
    steps = torch.tensor([(x * side + y) * side + z for x, y, z in product(range(reach), repeat=3)])
    x, y, z = cell.long().unbind(1)
    return ((x * side + y) * side + z)[:, None] + steps.to(cell.device)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """Products [N, J K] of weights [N, J] and [N, K]."""
    return (a[:, :, None] * b[:, None, :]).flatten(1)
