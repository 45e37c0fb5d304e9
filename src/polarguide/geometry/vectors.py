"""Vectors of three components along the last axis.

Products are written component by component, because PyTorch's reductions over three values are slow.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return scalar products [...] of vectors [..., 3]."""
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return ax * bx + ay * by + az * bz


def unit(vectors: Tensor, floor: float = 1e-6) -> Tensor:
    """Divide vectors [..., 3] by their length, or by ``floor`` if they are shorter than ``floor``; zero stays zero."""
    squared = dot(vectors, vectors)
    return vectors * torch.rsqrt(squared.clamp(min=floor * floor))[..., None]


def spread_directions(count: int) -> Tensor:
    """Return unit vectors [count, 3] float64, evenly distributed over the sphere (a Fibonacci lattice)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * place / count
    around = math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    return torch.stack((flat * around.cos(), flat * around.sin(), z), dim=1)


def unit_array(vectors: NDArray[Any]) -> NDArray[np.float64]:
    """Divide vectors [..., 3] in a NumPy array by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-300))
