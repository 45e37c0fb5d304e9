"""Three-vectors along the last axis. Written component by component: torch's reductions over three are slow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products [...] of vectors [..., 3]."""
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return ax * bx + ay * by + az * bz


def unit(vectors: Tensor, floor: float = 1e-6) -> Tensor:
    """Vectors [..., 3] divided by their length, or by ``floor`` where they are shorter; no NaN at zero."""
    squared = dot(vectors, vectors)
    return vectors * torch.rsqrt(squared.clamp(min=floor * floor))[..., None]


def spread_directions(count: int) -> Tensor:
    """Unit vectors [count, 3] float64, spread evenly over the sphere: a Fibonacci lattice."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * place / count
    around = math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    return torch.stack((flat * around.cos(), flat * around.sin(), z), dim=1)


def unit_array(vectors: NDArray[Any]) -> NDArray[np.float64]:
    """``unit`` for NumPy arrays: vectors [..., 3] divided by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-300))
