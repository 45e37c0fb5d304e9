"""Common functions of this package: safe arithmetic, window means, argument checks, and support of NumPy arrays.

The safe functions have finite values and gradients at points where the plain operation is singular. Examples are the
angle of an unpolarized pixel, and the azimuth of a normal that points to the camera. There the value is the limit, or
zero if no limit exists, and the gradient is zero. A single pixel therefore cannot spoil an optimization step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.geometry.vectors import dot


def safe_sqrt(x: Tensor) -> Tensor:
    """Return the square root. Value and gradient are zero for ``x <= 0``."""
    positive = x > 0
    root = torch.sqrt(torch.where(positive, x, torch.ones_like(x)))
    return torch.where(positive, root, torch.zeros_like(x))


def safe_atan2(y: Tensor, x: Tensor) -> Tensor:
    """Return ``atan2(y, x)`` in radians; value and gradient are zero if both y and x are zero.

    Subnormal floating-point numbers are treated as zero.
    """
    y, x = torch.broadcast_tensors(y, x)
    size = torch.maximum(y.abs(), x.abs()).detach()
    live = size > torch.finfo(size.dtype).tiny
    # Divide both by the larger one: the gradient divides by their squares, which could underflow.
    size = torch.where(live, size, torch.ones_like(size))
    y = torch.where(live, y, torch.zeros_like(y)) / size
    x = torch.where(live, x, torch.ones_like(x)) / size
    return torch.atan2(y, x)


def safe_normalize(vectors: Tensor) -> Tensor:
    """Normalize vectors along the last axis. Value and gradient are zero for vectors shorter than machine epsilon."""
    squared = dot(vectors, vectors)[..., None]
    live = squared > torch.finfo(vectors.dtype).eps ** 2
    inverse = torch.rsqrt(torch.where(live, squared, torch.ones_like(squared)))
    return vectors * torch.where(live, inverse, torch.zeros_like(inverse))


def window_mean(planes: Tensor, window: int) -> Tensor:
    """Return means over square windows of planes [K, H, W]. Beyond the border, its pixels are repeated.

    Raises:
        ValueError: ``window`` is not a positive odd number.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of pixels, found {window}")
    margin = window // 2
    _, height, width = planes.shape
    padded = pad(planes[None], (margin,) * 4, mode="replicate")[0]
    # Sums along columns, then along rows: 2 window terms per pixel, not window^2. PyTorch's pooling is slow.
    columns = sum((padded[:, k : k + height] for k in range(1, window)), padded[:, :height])
    return sum((columns[..., k : k + width] for k in range(1, window)), columns[..., :width]) / window**2


def check_leading(tensor: Tensor, count: int, name: str) -> None:
    """Raise ValueError unless the first axis of ``tensor`` has ``count`` entries."""
    if tensor.ndim == 0 or tensor.shape[0] != count:
        raise ValueError(f"{name}: expected shape [{count}, ...], found {list(tensor.shape)}")


def check_refractive_index(refractive_index: float | Tensor) -> None:
    """Raise ValueError if the refractive index is a number of 1 or less. Tensors are not checked."""
    if not isinstance(refractive_index, Tensor) and not refractive_index > 1.0:
        raise ValueError(f"refractive index: expected more than 1, found {refractive_index}")


F = TypeVar("F", bound=Callable[..., Any])


def for_arrays(function: F) -> F:
    """Make a function on tensors also accept NumPy arrays; it then returns arrays.

    Integers of up to 16 bits become float32, and other integers become float64. Floats become float32 or float64, and
    Booleans do not change. If any argument is a tensor, results are tensors.
    """

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        values = (*args, *options.values())
        if not _any(values, np.ndarray):
            return function(*args, **options)
        options = {name: _converted(value, _to_tensor) for name, value in options.items()}
        result = function(*_converted(args, _to_tensor), **options)
        return result if _any(values, Tensor) else _converted(result, _to_array)

    return called  # type: ignore[return-value]


def _any(value: Any, kind: type) -> bool:
    """Return True if a value, or any value in a tuple, is an instance of ``kind``."""
    if isinstance(value, tuple):
        return any(_any(item, kind) for item in value)
    return isinstance(value, kind)


def _converted(value: Any, convert: Callable[[Any], Any]) -> Any:
    """Apply ``convert`` to a value, or to all values of a tuple or named tuple."""
    if not isinstance(value, tuple):
        return convert(value)
    items = [_converted(item, convert) for item in value]
    return type(value)(*items) if hasattr(value, "_fields") else tuple(items)


def _to_tensor(value: Any) -> Any:
    """Convert a NumPy array to a tensor of floats or Booleans; other values are unchanged."""
    if not isinstance(value, np.ndarray):
        return value
    size = value.dtype.itemsize
    if value.dtype.kind in "iu":
        value = value.astype(np.float32 if size <= 2 else np.float64)
    elif value.dtype.kind == "f":
        value = value.astype(np.float32 if size < 4 else f"f{min(size, 8)}", copy=False)
    elif value.dtype.kind != "b":
        raise TypeError(f"expected an array of numbers, found one of {value.dtype}")
    # PyTorch requires writable arrays without reversed axes.
    return torch.from_numpy(np.require(value, requirements=["C", "W"]))


def _to_array(value: Any) -> Any:
    """Convert a tensor to a NumPy array; other values are unchanged."""
    return value.numpy() if isinstance(value, Tensor) else value
