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
    parts = _strided(codes, factor)
    total = np.zeros(parts[0].shape, np.uint64)
    for part in parts:
        total += part
    area = factor * factor
    return ((total + area // 2) // area).astype(np.uint16)


def mean(values: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Box means of [H, W] or [H, W, C]."""
    if factor == 1:
        return values
    return _boxed(values, factor).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def maximum(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """Maximum over each box of ``factor`` x ``factor`` pixels of an array [H, W]; of booleans, whether any is True."""
    return functools.reduce(np.maximum, _strided(values, factor)).copy()


def every(values: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Whether all pixels of each box are True, of [H, W].

    This is what foreground masks mean at a smaller size: a box that is the subject in part holds background, which is
    neither to be trained on nor scored as the subject. Invalid and saturated pixels take ``maximum``: one spoils a box.
    """
    return np.asarray(_boxed(values, factor).all(axis=(1, 3)))


def agreed(numbers: NDArray[np.int32], factor: int) -> NDArray[np.int32]:
    """The number that all pixels of a box share, of [H, W]; 0 where they differ."""
    first, *others = _strided(numbers, factor)
    same = functools.reduce(np.logical_and, (first == other for other in others), np.full(first.shape, True))
    return np.where(same, first, 0).astype(np.int32)


def unit_mean(normals: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Box means of vectors [H, W, 3], brought back to unit length; zero where they cancel."""
    average = mean(normals, factor)
    length = np.linalg.norm(average, axis=-1, keepdims=True)
    return np.where(length > 1e-6, average / np.maximum(length, 1e-6), 0.0).astype(np.float32)


def _strided(values: NDArray[Any], factor: int) -> list[NDArray[Any]]:
    """The K x K pixels of every box, each as [H // K, W // K, ...].

    For work element by element: NumPy reduces over short axes an order of magnitude slower.
    """
    height = values.shape[0] // factor * factor
    width = values.shape[1] // factor * factor
    return [values[i:height:factor, j:width:factor] for i in range(factor) for j in range(factor)]


def _boxed(values: NDArray[Any], factor: int) -> NDArray[Any]:
    """[H, W, ...] -> [H // K, K, W // K, K, ...]."""
    rows = values.shape[0] // factor
    columns = values.shape[1] // factor
    cut = values[: rows * factor, : columns * factor]
    return cut.reshape(rows, factor, columns, factor, *values.shape[2:])
