"""Clusters of evidence: what lies in one cell of space shares its errors."""

from __future__ import annotations

import torch
from torch import Tensor

CELLS = 12
"""Cells along the longest side of the middle 90 % of the places."""


def cells(places: Tensor) -> Tensor:
    """Number of the cell of each place, [N] int64, from 0 up without gaps. places: [N, 3]."""
    step = max(1, len(places) // 100_000)
    low, high = (torch.quantile(places[::step].double(), q, dim=0) for q in (0.05, 0.95))
    side = float((high - low).max()) / CELLS
    if side <= 0:
        return torch.zeros(len(places), dtype=torch.int64)
    # Cells far outside are one cell: stray points are few.
    numbers = ((places.double() - low) / side).floor().clamp(-1, CELLS + 1).long() + 1
    key = (numbers[:, 0] * (CELLS + 3) + numbers[:, 1]) * (CELLS + 3) + numbers[:, 2]
    return torch.unique(key, return_inverse=True)[1]


def cluster_sums(values: Tensor, numbers: Tensor) -> Tensor:
    """Sums [C, ...] of values [N, ...] over the clusters that ``numbers`` [N] name."""
    count = int(numbers.max()) + 1 if len(numbers) else 1
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, numbers, values)
