"""Downscaling with a box filter of K x K pixels; incomplete boxes at the right and bottom are dropped."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mean_codes(codes: NDArray[np.uint16], factor: int) -> NDArray[np.uint16]:
    """Average linear codes over boxes with rounding, [H, W, C] uint16 -> [H // K, W // K, C] uint16."""
    if factor == 1:
        return codes
    parts = _strided(codes, factor)
    total = np.zeros(parts[0].shape, np.uint64)
    for part in parts:
        total += part
    area = factor * factor
    return ((total + area // 2) // area).astype(np.uint16)


def mean(values: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Average values [H, W] or [H, W, C] over boxes."""
    if factor == 1:
        return values
    return _boxed(values, factor).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def maximum(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """Return the maximum over each box of an array [H, W]; for masks, True if any pixel is."""
    return functools.reduce(np.maximum, _strided(values, factor)).copy()


def every(values: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Return a mask of boxes whose pixels are all True, from [H, W].

    Foreground masks are downscaled this way. A box with some background must not count as subject in training and
    scores. Invalid and saturated pixels use ``maximum``.
    """
    return np.asarray(_boxed(values, factor).all(axis=(1, 3)))


def agreed(numbers: NDArray[np.int32], factor: int) -> NDArray[np.int32]:
    """Return the number that all pixels of a box share, from [H, W]; 0 if they differ."""
    first, *others = _strided(numbers, factor)
    same = functools.reduce(np.logical_and, (first == other for other in others), np.full(first.shape, True))
    return np.where(same, first, 0).astype(np.int32)


def unit_mean(normals: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Average vectors [H, W, 3] over boxes and normalize them; zero if they cancel."""
    average = mean(normals, factor)
    length = np.linalg.norm(average, axis=-1, keepdims=True)
    return np.where(length > 1e-6, average / np.maximum(length, 1e-6), 0.0).astype(np.float32)


def _strided(values: NDArray[Any], factor: int) -> list[NDArray[Any]]:
    """Return the K x K pixels of every box as arrays [H // K, W // K, ...].

    NumPy reduces over short axes an order of magnitude slower.
    """
    height = values.shape[0] // factor * factor
    width = values.shape[1] // factor * factor
    return [values[i:height:factor, j:width:factor] for i in range(factor) for j in range(factor)]


def _boxed(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """Split [H, W, ...] into boxes [H // K, K, W // K, K, ...]."""
    rows = values.shape[0] // factor
    columns = values.shape[1] // factor
    return values[: rows * factor, : columns * factor].reshape(
        rows, factor, columns, factor, *values.shape[2:]
    )
