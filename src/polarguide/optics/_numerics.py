"""Shared by the modules of this package: NumPy arrays in and out, safe arithmetic, window means, argument checks.

The safe functions stay finite, value and gradient, where the plain operation is singular: at the angle of an
unpolarized pixel, the azimuth of a normal that points at the camera, the square root in a zenith at zero degree
of polarization. There the value is the limit (or zero where there is none) and the gradient is zero, so that
one pixel cannot spoil an optimization step.
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
    """Square root; value and gradient are zero where ``x <= 0``."""
    positive = x > 0
    root = torch.sqrt(torch.where(positive, x, torch.ones_like(x)))
    return torch.where(positive, root, torch.zeros_like(x))


def safe_atan2(y: Tensor, x: Tensor) -> Tensor:
    """``atan2(y, x)`` in radians; value and gradient are zero where both y and x are.

    A number below the smallest normal floating-point number counts as zero.
    """
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


F = TypeVar("F", bound=Callable[..., Any])


def for_arrays(function: F) -> F:
    """Let a function on tensors also take NumPy arrays, for which it returns arrays.

    Whole numbers become floating-point ones (float32 up to 16 bits, else float64), floats are float32 or float64,
    Booleans stay. Where any argument is a tensor the result is tensors; with neither, what the function makes of it.
    """

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        values = (*args, *options.values())
        if not _any(values, np.ndarray):
            return function(*args, **options)
        result = function(
            *(_to_tensor(value) for value in args), **{key: _to_tensor(v) for key, v in options.items()}
        )
        return result if _any(values, Tensor) else _to_array(result)

    return called  # type: ignore[return-value]


def _any(value: Any, kind: type) -> bool:
    """Whether a value, or one in a tuple of values, is of a type."""
    if isinstance(value, tuple):
        return any(_any(item, kind) for item in value)
    return isinstance(value, kind)


def _to_tensor(value: Any) -> Any:
    if isinstance(value, tuple):
        return _like(value, [_to_tensor(item) for item in value])
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind in "iu":
        value = value.astype(np.float32 if value.dtype.itemsize <= 2 else np.float64)
    elif value.dtype.kind == "f":
        value = value.astype(
            np.float32 if value.dtype.itemsize < 4 else f"f{min(value.dtype.itemsize, 8)}", copy=False
        )
    elif value.dtype.kind != "b":
        raise TypeError(f"expected an array of numbers, found one of {value.dtype}")
    # torch knows neither reversed axes nor arrays that may not be written to.
    return torch.from_numpy(np.require(value, requirements=["C", "W"]))


def _to_array(value: Any) -> Any:
    if isinstance(value, tuple):
        return _like(value, [_to_array(item) for item in value])
    return value.numpy() if isinstance(value, Tensor) else value


def _like(example: Any, items: list[Any]) -> Any:
    """A tuple of the same kind, named or not."""
    return type(example)(*items) if hasattr(example, "_fields") else tuple(items)
