"""The display transfer: sRGB (IEC 61966-2-1). Radiance is linear everywhere else."""

from __future__ import annotations

import torch
from torch import Tensor


def srgb_encode(linear: Tensor) -> Tensor:
    """Linear values to shown ones: ``12.92 v`` up to 0.0031308, else ``1.055 v^(1/2.4) - 0.055``.

    Args:
        linear: any shape; [0, 1] maps to [0, 1], both ends exactly. Not clipped: the
            straight part goes on below 0, the curve above 1.

    Returns:
        The same shape, differentiable.
    """
    curved = 1.055 * (linear.clamp(min=0.0031308) ** (1 / 2.4) - 1) + 1  # exactly 1 at 1
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode(shown: Tensor) -> Tensor:
    """Shown values to linear ones: ``v / 12.92`` up to 0.04045, else ``((v + 0.055) / 1.055)^2.4``.

    Args:
        shown: any shape; [0, 1] maps to [0, 1]. Not clipped.

    Returns:
        The same shape, differentiable.
    """
    curved = ((shown.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(shown <= 0.04045, shown / 12.92, curved)
