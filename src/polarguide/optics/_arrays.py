"""NumPy in, NumPy out: the functions of this package are written for torch, and serve both."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

F = TypeVar("F", bound=Callable[..., Any])


def for_arrays(function: F) -> F:
    """Let a function on tensors take NumPy arrays, too, and then return arrays.

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
