"""The display transfer: sRGB (IEC 61966-2-1). Radiance is linear everywhere else."""

from __future__ import annotations

import torch
from torch import Tensor


def srgb_encode(linear: Tensor) -> Tensor:
    """Linear values in [0, 1] to shown ones, any shape; below 0 the linear part goes on. Differentiable."""
    curved = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode(shown: Tensor) -> Tensor:
    """Shown values in [0, 1] to linear ones, any shape. Differentiable."""
    curved = ((shown.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(shown <= 0.04045, shown / 12.92, curved)
