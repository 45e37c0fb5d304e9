"""What the modules of this package share: safe arithmetic, means over windows, checks of arguments.

The safe functions stay finite, value and gradient, where the plain operation is singular: at the angle of an
unpolarized pixel, the azimuth of a normal that points at the camera, the square root in a zenith at zero degree
of polarization. There the value is the limit (or zero where there is none) and the gradient is zero, so that
one pixel cannot spoil an optimization step.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.vectors import dot


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root; value and gradient are zero where ``x <= 0``."""
    positive = x > 0
    root = torch.sqrt(torch.where(positive, x, torch.ones_like(x)))
    return torch.where(positive, root, torch.zeros_like(x))


def safe_atan2(y: Tensor, x: Tensor) -> Tensor:
    """``atan2(y, x)`` in radians; value and gradient are zero where both are (below the smallest normal)."""
    y, x = torch.broadcast_tensors(y, x)
    size = torch.maximum(y.abs(), x.abs()).detach()
    live = size > torch.finfo(size.dtype).tiny
    # Scaling by the larger of the two keeps their squares, which the gradient divides by, from underflowing.
    size = torch.where(live, size, torch.ones_like(size))
    y = torch.where(live, y, torch.zeros_like(y)) / size
    x = torch.where(live, x, torch.ones_like(x)) / size
    return torch.atan2(y, x)


def safe_normalize(vectors: Tensor) -> Tensor:
    """Unit vectors along the last axis; zero (gradient too) where the length is below machine epsilon."""
    squared = dot(vectors, vectors)[..., None]
    live = squared > torch.finfo(vectors.dtype).eps ** 2
    inverse = torch.rsqrt(torch.where(live, squared, torch.ones_like(squared)))
    return vectors * torch.where(live, inverse, torch.zeros_like(inverse))


def window_mean(planes: Tensor, window: int) -> Tensor:
    """Means over square windows of planes [K, H, W]; the border's pixels are repeated beyond it.

    Raises:
        ValueError: ``window`` is not a positive odd number.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of pixels, found {window}")
    margin = window // 2
    _, height, width = planes.shape
    padded = pad(planes[None], (margin,) * 4, mode="replicate")[0]
    # Along the columns, then along the rows: 2 window sums a pixel, not window^2; and torch's pooling is slow.
    columns = sum((padded[:, k : k + height] for k in range(1, window)), padded[:, :height])
    return sum((columns[..., k : k + width] for k in range(1, window)), columns[..., :width]) / window**2


def check_leading(tensor: Tensor, count: int, name: str) -> None:
    """Raise ValueError unless the first axis of ``tensor`` has ``count`` entries."""
    if tensor.ndim == 0 or tensor.shape[0] != count:
        raise ValueError(f"{name}: expected shape [{count}, ...], found {list(tensor.shape)}")


def check_refractive_index(refractive_index: float | Tensor) -> None:
    """Raise ValueError unless a refractive index given as a number exceeds 1 (tensors are not read)."""
    if not isinstance(refractive_index, Tensor) and not refractive_index > 1.0:
        raise ValueError(f"refractive index: expected more than 1, found {refractive_index}")
