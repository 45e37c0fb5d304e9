"""Transfer function of displays, sRGB (IEC 61966-2-1). All other modules use linear radiance."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def srgb_encode(linear: Tensor) -> Tensor:
    """Encode linear values for a display: ``12.92 v`` up to 0.0031308, else ``1.055 v^(1/2.4) - 0.055``.

    Args:
        linear: values of any shape. [0, 1] maps to [0, 1], with both ends exact. Values outside are not clipped: the
            straight part extends below 0, and the curve extends above 1.

    Returns:
        The same shape, differentiable.
    """
    curved = 1.055 * (linear.clamp(min=0.0031308) ** (1 / 2.4) - 1) + 1  # exactly 1 for 1
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode(encoded: Tensor) -> Tensor:
    """Decode display values to linear values: ``v / 12.92`` up to 0.04045, else ``((v + 0.055) / 1.055)^2.4``.

    Args:
        encoded: values of any shape. [0, 1] maps to [0, 1]. Values outside are not clipped.

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
    """Return the derivative of ``srgb_encode``, but at least its value at 1.

    It tells how visible a small error of a linear value is on a display.
    """
    curved = 1.055 / 2.4 * linear.clamp(0.0031308, 1.0) ** (1 / 2.4 - 1)
    return torch.where(linear <= 0.0031308, 12.92, curved)


def srgb_encode_array(linear: NDArray[Any]) -> NDArray[Any]:
    """Encode linear values in [0, 1] for a display, as ``srgb_encode`` does, but for NumPy arrays."""
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curved)


def srgb_decode_array(encoded: NDArray[Any]) -> NDArray[Any]:
    """Decode display values in [0, 1], as ``srgb_decode`` does, but for NumPy arrays."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
