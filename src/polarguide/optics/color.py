"""Transfer function of displays: sRGB (IEC 61966-2-1). Radiance is linear everywhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def srgb_encode(linear: Tensor) -> Tensor:
    """Encode linear values for a display: ``12.92 v`` up to 0.0031308, else ``1.055 v^(1/2.4) - 0.055``.

    Args:
        linear: any shape; [0, 1] maps to [0, 1], both ends exactly. Values are not clipped: the straight part extends
            below 0, the curve above 1.

    Returns:
        The same shape, differentiable.
    """
    curved = 1.055 * (linear.clamp(min=0.0031308) ** (1 / 2.4) - 1) + 1  # exactly 1 for 1
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode(encoded: Tensor) -> Tensor:
    """Decode display values to linear values: ``v / 12.92`` up to 0.04045, else ``((v + 0.055) / 1.055)^2.4``.

    Args:
        encoded: any shape; [0, 1] maps to [0, 1]. Values are not clipped.

    Returns:
        The same shape, differentiable.
    """
    curved = ((encoded.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curved)


def shown(linear: Tensor) -> Tensor:
    """Return display values of a picture: clipped to [0, 1], then ``srgb_encode``. NaN stays NaN.

    Args:
        linear: [...] linear radiance.
    """
    return srgb_encode(linear.clamp(0.0, 1.0))


def srgb_slope(linear: Tensor) -> Tensor:
    """Return the derivative of ``srgb_encode``, at least its value at 1: the visibility of a linear error."""
    curved = 1.055 / 2.4 * linear.clamp(0.0031308, 1.0) ** (1 / 2.4 - 1)
    return torch.where(linear <= 0.0031308, 12.92, curved)


def srgb_encode_array(linear: NDArray[Any]) -> NDArray[Any]:
    """Encode linear values in [0, 1] for a display; ``srgb_encode`` for NumPy arrays."""
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode_array(encoded: NDArray[Any]) -> NDArray[Any]:
    """Decode display values in [0, 1]; ``srgb_decode`` for NumPy arrays."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
