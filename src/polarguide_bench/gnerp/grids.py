"""Dense grids over a cube at several resolutions, whose interpolated values are linear in their parameters.

Value and gradient of a grid at a point are weighted sums of the same few nodes. So the gradient of a loss on normals is
computed without second derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn


class _Gather(torch.autograd.Function):
    """``out[n, q, c] = sum over k of weights[n, q, k] table[nodes[n, k], c]``, differentiable in the table alone."""

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
        if ctx.shape[1] == 1:  # on the CPU much faster than rows of one
            table.view(-1).scatter_add_(0, nodes.flatten(), spread.flatten())
        else:
            table.index_add_(0, nodes.flatten(), spread.view(-1, ctx.shape[1]))
        return table, None, None


class SmoothGrids(nn.Module):
    """Scalar function: a sum of quadratic B-splines on several grids, initially zero.

    Its gradient is continuous.

    Args:
        resolutions: number of cells of each grid along a side of the cube [-1, 1]^3.
    """

    def __init__(self, resolutions: Sequence[int]) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        self.levels = nn.ParameterList(torch.zeros((n + 2) ** 3, 1) for n in resolutions)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Compute values [N] and gradients [N, 3] at positions [N, 3], which are clamped to the cube."""
        sums = torch.zeros(len(places), 4, 1, dtype=places.dtype, device=places.device)
        for resolution, table in zip(self.resolutions, self.levels, strict=True):
            sums = sums + _Gather.apply(table, *spline_weights(places, resolution))
        return sums[:, 0, 0], sums[:, 1:, 0]


class FeatureGrids(nn.Module):
    """Features, which are trilinear interpolations on several grids, concatenated.

    Args:
        resolutions: cells of each grid along a side of the cube [-1, 1]^3.
        channels: number of channels of each grid.
        spread: initial values are uniform in [-spread, spread].
        generator: source of the initial values.
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
        """Compute features [N, width] at positions [N, 3], which are clamped to the cube."""
        features = []
        for resolution, table in zip(self.resolutions, self.levels, strict=True):
            nodes, weights = linear_weights(places, resolution)
            features.append(_Gather.apply(table, nodes, weights[:, None])[:, 0])
        return torch.cat(features, dim=1)


def spline_weights(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Return the 27 nodes around each position [N, 3], and their weights [N, 4, 27] for value and gradient.

    Let t in [0, 1] be the coordinate of a position within its cell along an axis. The weight of the previous cell is (1
    - t)^2 / 2, the weight of the cell itself is 1/2 + t - t^2, and the weight of the next cell is t^2 / 2. So a grid
    needs an additional layer of nodes around the cube.
    """
    cell, t = _cell(places, resolution)
    nodes = _nodes(cell, resolution + 2, 3)
    slope = torch.stack((t - 1, 1 - 2 * t, t), dim=-1) * (0.5 * resolution)
    wx, wy, wz = _quadratic(t).unbind(1)
    sx, sy, sz = slope.unbind(1)
    across = _outer(wy, wz)
    rows = (_outer(wx, across), _outer(sx, across), _outer(wx, _outer(sy, wz)), _outer(wx, _outer(wy, sz)))
    return nodes, torch.stack(rows, dim=1)


def spline_matrix(axis: Tensor, resolution: int) -> Tensor:
    """Return the weights [M, resolution + 2] of a grid's nodes along one axis for positions [M] on this axis."""
    cell, t = _cell(axis, resolution)
    nodes = cell.long()[:, None] + torch.arange(3, device=axis.device)
    return axis.new_zeros(len(axis), resolution + 2).scatter_(1, nodes, _quadratic(t))


def linear_weights(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Return the 8 nodes [N, 8] around each position [N, 3], and their trilinear weights [N, 8]."""
    cell, t = _cell(places, resolution)
    wx, wy, wz = torch.stack((1 - t, t), dim=-1).unbind(1)
    return _nodes(cell, resolution + 1, 2), _outer(wx, _outer(wy, wz))


def _quadratic(t: Tensor) -> Tensor:
    """Return weights [..., 3] of a quadratic B-spline at positions t [...] in a cell."""
    return torch.stack((0.5 * (1 - t) ** 2, 0.5 + t - t * t, 0.5 * t * t), dim=-1)


def _cell(places: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Return the cell index [...] of each position along an axis, and the position within the cell, in [0, 1]."""
    scaled = (0.5 * resolution) * (places.clamp(-1, 1) + 1)
    cell = scaled.floor().clamp(max=resolution - 1)
    return cell, scaled - cell


def _nodes(cell: Tensor, side: int, reach: int) -> Tensor:
    """Return the indices of the block of nodes that begins at each cell.

    The block has ``reach`` nodes along each axis. The grid has ``side`` nodes along each axis.
    """
    steps = torch.tensor([(x * side + y) * side + z for x, y, z in product(range(reach), repeat=3)])
    x, y, z = cell.long().unbind(1)
    return ((x * side + y) * side + z)[:, None] + steps.to(cell.device)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """Return all products [N, J K] of weights [N, J] and weights [N, K]."""
    return (a[:, :, None] * b[:, None, :]).flatten(1)
