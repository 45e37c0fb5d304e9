"""Sample raw mosaics, to estimate gains and white balance of a whole capture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.pattern import Pattern
from polarguide.capture.sensor.radiometry import Levels
from polarguide.capture.view import ANGLES

_BLOCKS = 1024


def sample_blocks(values: NDArray[Any], size: int) -> NDArray[Any]:
    """A regular subset of a mosaic's blocks, [N, size, size]."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    found = grid.swapaxes(1, 2).reshape(-1, size, size)
    return found[:: max(1, len(found) // _BLOCKS)].copy()


def block_intensities(
    samples: list[NDArray[Any]],
    levels: Levels,
    floor: NDArray[np.float32] | None,
    pattern: Pattern,
    matrices: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Intensities at the centers of blocks: by angle [4, N], by color [3, N], and whether each is usable [N].

    Samples of different angles lie beside one another; weights that interpolate all of them to the center of a
    block of two periods keep gradients of the picture out of the ratio of the pair sums.

    Args:
        samples: ``sample_blocks`` of two periods from each mosaic.
        levels: of the capture.
        floor: ``sample_blocks`` of the dark frame, or None.
        pattern: of the mosaics.
        matrices: [4, 4, ...]: ``sample_blocks`` of the corrections of cells, in blocks of one period, or None.
    """
    values = np.concatenate(samples)
    dark = None if floor is None else np.tile(floor, (len(samples), 1, 1))
    linear = levels.linear(values, dark).astype(np.float64)
    period = pattern.period
    if matrices is not None:
        cells = linear.reshape(len(samples), -1, period, 2, period, 2)
        planes = [cells[..., row, :, column].copy() for row, column in np.ndindex(2, 2)]
        for index, (row, column) in enumerate(np.ndindex(2, 2)):
            done = sum(matrices[index, other] * plane for other, plane in enumerate(planes))
            cells[..., row, :, column] = done
    rising = (np.arange(period) + 0.5) / period
    tent = np.concatenate([rising, rising[::-1]])
    weighted = linear * tent[:, None] * tent
    places = np.tile(pattern.angles, (2, 2))
    # The weights of one angle and color add up to 1 a sample of the period.
    angles = np.stack([weighted[:, places == angle].sum(axis=1) for angle in ANGLES])
    angles *= 4 / period**2
    colors = np.ones((3, len(values)))
    if pattern.colors is not None:
        filters = np.tile(pattern.colors, (2, 2))
        colors = np.stack([weighted[:, filters == c].sum(axis=1) for c in range(3)]) / [[4], [8], [4]]
    base = levels.black if dark is None else dark
    usable = (values < levels.saturation).all(axis=(1, 2)) & (values > base).any(axis=(1, 2))
    return angles, colors, np.asarray(usable)


def gray_world(colors: NDArray[np.float64]) -> tuple[float, float, float]:
    """Gains that make the mean of [3, N] colors gray; green keeps its own."""
    mean = np.maximum(colors.mean(axis=1) if colors.size else np.ones(3), 1e-6)
    return float(mean[1] / mean[0]), 1.0, float(mean[1] / mean[2])
