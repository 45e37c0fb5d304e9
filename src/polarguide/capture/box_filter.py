"""Downscaling with a box filter of K x K pixels; incomplete boxes at the right and bottom are dropped."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mean_codes(codes: NDArray[np.uint16], factor: int) -> NDArray[np.uint16]:
    """Rounded box means of linear codes, [H, W, C] uint16 -> [H // K, W // K, C] uint16."""
    if factor == 1:
        return codes
    height, width = codes.shape[0] // factor * factor, codes.shape[1] // factor * factor
    total = np.zeros((height // factor, width // factor, codes.shape[2]), np.uint64)
    for row in range(factor):
        for column in range(factor):
            total += codes[row:height:factor, column:width:factor]
    area = factor * factor
    return ((total + area // 2) // area).astype(np.uint16)


def mean(values: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Box means of [H, W] or [H, W, C]."""
    if factor == 1:
        return values
    return _boxed(values, factor).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def maximum(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """The largest value of each box, of [H, W]; for bool: whether any is True."""
    height, width = values.shape[0] // factor * factor, values.shape[1] // factor * factor
    # Element-wise over strided slices: NumPy reduces over short axes an order of magnitude slower.
    slices = [values[i:height:factor, j:width:factor] for i in range(factor) for j in range(factor)]
    return functools.reduce(np.maximum, slices).copy()


def every(values: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Whether all pixels of each box are True, of [H, W]."""
    return np.asarray(_boxed(values, factor).all(axis=(1, 3)))


def unit_mean(normals: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Box means of vectors [H, W, 3], brought back to unit length; zero where they cancel."""
    average = mean(normals, factor)
    length = np.linalg.norm(average, axis=-1, keepdims=True)
    return np.where(length > 1e-6, average / np.maximum(length, 1e-6), 0.0).astype(np.float32)


def _boxed(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """[H, W, ...] -> [H // K, K, W // K, K, ...]."""
    rows, columns = values.shape[0] // factor, values.shape[1] // factor
    cut = values[: rows * factor, : columns * factor]
    return cut.reshape(rows, factor, columns, factor, *values.shape[2:])
