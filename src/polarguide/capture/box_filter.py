"""Downscale arrays by averaging boxes of K x K pixels. Incomplete boxes at the right and bottom are left out."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mean_codes(codes: NDArray[Any], factor: int) -> NDArray[Any]:
    """Average linear codes [H, W, C] over boxes, [H // K, W // K, C]. The mean of uint16 codes is rounded to uint16."""
    if factor == 1:
        return codes
    if codes.dtype.kind == "f":
        return mean(codes, factor)
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
    """Return the maximum over each box of an array [H, W]. For a mask, it is True if any pixel of the box is True."""
    return functools.reduce(np.maximum, _strided(values, factor)).copy()


def every(values: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Return True for each box of a mask [H, W] in which all pixels are True.

    This is used for foreground masks, because a box with some background must not be part of the subject. Masks of
    invalid and saturated pixels are downscaled by ``maximum`` instead.
    """
    return np.asarray(_boxed(values, factor).all(axis=(1, 3)))


def agreed(numbers: NDArray[np.int32], factor: int) -> NDArray[np.int32]:
    """Return the number of each box of an array [H, W] if all of its pixels are equal, and 0 if they differ."""
    first, *others = _strided(numbers, factor)
    same = functools.reduce(np.logical_and, (first == other for other in others), np.full(first.shape, True))
    return np.where(same, first, 0).astype(np.int32)


def unit_mean(normals: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Average vectors [H, W, 3] over boxes, and normalize them. A mean of zero remains zero."""
    average = mean(normals, factor)
    length = np.linalg.norm(average, axis=-1, keepdims=True)
    return np.where(length > 1e-6, average / np.maximum(length, 1e-6), 0.0).astype(np.float32)


def _strided(values: NDArray[Any], factor: int) -> list[NDArray[Any]]:
    """Return a list of K x K arrays [H // K, W // K, ...]. Each has the pixels at one position in all boxes.

    Combining these arrays is an order of magnitude faster than a reduction over short axes in NumPy.
    """
    height = values.shape[0] // factor * factor
    width = values.shape[1] // factor * factor
    return [values[i:height:factor, j:width:factor] for i in range(factor) for j in range(factor)]


def _boxed(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """Reshape an array [H, W, ...] to boxes, [H // K, K, W // K, K, ...]."""
    rows = values.shape[0] // factor
    columns = values.shape[1] // factor
    return values[: rows * factor, : columns * factor].reshape(
        rows, factor, columns, factor, *values.shape[2:]
    )
