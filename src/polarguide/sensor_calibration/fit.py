"""Analyzer vectors of all pixels, by linear least squares, and their means over blocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.analyzers import LEAST_DIATTENUATION, grid_shape
from polarguide.capture.sensor.pattern import Pattern

BLOCK = 32
"""Side of a block in pixels, where it is not given."""
NEIGHBORHOOD = 31
"""Cells of one color, each way, whose mean brightness is that of a uniform light at the middle one."""
LEAST_THROUGHPUT, MOST_THROUGHPUT, MOST_DIATTENUATION = 0.5, 1.5, 1.3
FARTHEST_ANGLE = np.radians(20.0)
"""What deviates more than these is a defect of the sensor, not a polarizer."""

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PixelFit:
    """Analyzer vectors of single pixels.

    Attributes:
        vectors: [H, W, 3]; around each pixel, the mean of the first components of its color is 1/2.
        noise: variance of a vector (the sum over its three components) by the deviations of its shots, mean over pixels.
        defects: pixels without a plausible polarizer, [H, W].
    """

    vectors: Array
    noise: float
    defects: NDArray[np.bool_]


@dataclass(frozen=True)
class BlockChoice:
    """Whether pixels get vectors of their own.

    Attributes:
        block: side in pixels of what shares a vector; the pattern's period for single pixels.
        noise: standard deviation of a single pixel's vector by noise, as a share of its throughput.
        scatter: the same of what really differs between the pixels of a block.
    """

    block: int
    noise: float
    scatter: float


def fit_pixels(
    shots: Iterable[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    light: NDArray[np.float64],
    pattern: Pattern,
) -> PixelFit:
    """Fit the vector of each pixel.

    Args:
        shots: linear intensities [H, W] of each shot, and whether they are saturated.
        light: Stokes vectors of the shots, [T, 3].
        pattern: of the region.
    """
    moments: Any = None
    for (values, clipped), stokes in zip(shots, light, strict=True):
        if moments is None:
            moments = np.zeros((3, *values.shape))
            squares, saturated = np.zeros(values.shape), np.zeros(values.shape, bool)
        for component in range(3):
            moments[component] += stokes[component] * values
        squares += np.square(values, dtype=np.float64)
        saturated |= clipped
    normal = np.linalg.inv(light.T @ light)
    vectors = np.einsum("ij,jhw->ihw", normal, moments)
    rest = np.maximum(squares - np.einsum("ihw,ihw->hw", vectors, moments), 0.0)
    variance = rest / max(1, len(light) - 3)
    level = _brightness(2 * vectors[0], pattern)
    vectors /= level
    defects = saturated | ~plausible(np.moveaxis(vectors, 0, -1), _nominal(pattern, squares.shape))
    sound = ~defects
    noise = float(np.mean((variance / level**2)[sound]) * np.trace(normal)) if sound.any() else 0.0
    return PixelFit(np.ascontiguousarray(np.moveaxis(vectors, 0, -1), np.float32), noise, defects)


def plausible(vectors: Any, nominal: Any) -> NDArray[np.bool_]:
    """Whether vectors [..., 3] are those of polarizers near their nominal angles (radians, broadcastable to [...])."""
    gain = 2 * vectors[..., 0]
    strength = 2 * np.hypot(vectors[..., 1], vectors[..., 2])
    cosine = vectors[..., 1] * np.cos(2 * nominal) + vectors[..., 2] * np.sin(2 * nominal)
    return np.asarray(
        (gain > LEAST_THROUGHPUT)
        & (gain < MOST_THROUGHPUT)
        & (strength > LEAST_DIATTENUATION * gain)
        & (strength < MOST_DIATTENUATION * gain)
        & (2 * cosine > strength * np.cos(2 * FARTHEST_ANGLE))
    )


def choose_block(pixels: PixelFit, offset: tuple[int, int], pattern: Pattern, asked: int | None) -> BlockChoice:
    """Choose what shares a vector: single pixels where their noise is less than what their mean over a block hides."""
    means = block_means(pixels, offset, BLOCK, pattern)
    deviation = pixels.vectors - _at_pixels(means, offset, BLOCK, pattern, pixels.vectors.shape)
    sound = ~pixels.defects
    spread = float((deviation[sound] ** 2).sum(axis=1).mean()) if sound.any() else 0.0
    scatter = max(0.0, spread - pixels.noise)
    block = BLOCK if scatter <= pixels.noise else pattern.period
    if asked is not None:
        block = pattern.period if asked == 1 else asked
    return BlockChoice(block, 2 * pixels.noise**0.5, 2 * scatter**0.5)


def shared(pixels: PixelFit, offset: tuple[int, int], block: int, pattern: Pattern) -> Array:
    """The vectors that go into the file: means over blocks, in which defects have no part.

    Where each pixel has its own, a defect gets the mean of its neighborhood.

    Args:
        pixels: the single vectors. offset: column and row of the sensor at which they start. block: side in pixels.
        pattern: of the region.

    Returns:
        [rows, columns, P, P, 3] as in ``AnalyzerCalibration.vectors``.
    """
    if block > pattern.period:
        return block_means(pixels, offset, block, pattern)
    around = _at_pixels(block_means(pixels, offset, BLOCK, pattern), offset, BLOCK, pattern, pixels.vectors.shape)
    vectors = np.where(pixels.defects[..., None], around, pixels.vectors)
    return block_means(replace(pixels, vectors=vectors, defects=np.zeros_like(pixels.defects)), offset, block, pattern)


def block_means(pixels: PixelFit, offset: tuple[int, int], block: int, pattern: Pattern) -> Array:
    """Mean vectors of blocks by place in the pattern of the sensor; the mean over the sensor where no pixel is sound."""
    height, width, _ = pixels.vectors.shape
    period = pattern.period
    rows, columns = grid_shape(offset, (width, height), block)
    out = np.zeros((rows, columns, period, period, 3))
    for row, column in np.ndindex(period, period):
        part = pixels.vectors[row::period, column::period]
        sound = ~pixels.defects[row::period, column::period]
        y = (np.arange(row, height, period) + offset[1]) // block - offset[1] // block
        x = (np.arange(column, width, period) + offset[0]) // block - offset[0] // block
        where = (y[:, None] * columns + x)[sound]
        count = np.bincount(where, minlength=rows * columns)
        sums = [np.bincount(where, part[..., k][sound], rows * columns) for k in range(3)]
        found = np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]
        found[count == 0] = part[sound].mean(axis=0, dtype=np.float64)
        out[:, :, (row + offset[1]) % period, (column + offset[0]) % period] = found.reshape(rows, columns, 3)
    return out.astype(np.float32)


def _at_pixels(
    means: Array, offset: tuple[int, int], block: int, pattern: Pattern, shape: tuple[int, ...]
) -> Array:
    """The vectors of blocks at each pixel, [H, W, 3]."""
    y, x = np.arange(shape[0]) + offset[1], np.arange(shape[1]) + offset[0]
    rows, columns = y // block - offset[1] // block, x // block - offset[0] // block
    period = pattern.period
    return np.asarray(means[rows[:, None], columns, (y % period)[:, None], x % period])


def _nominal(pattern: Pattern, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Nominal angle of each pixel in radians, [H, W]."""
    period = pattern.period
    repeat = [-(-length // period) for length in shape]
    return np.radians(np.tile(pattern.angles, repeat)[: shape[0], : shape[1]])


def _brightness(throughput: NDArray[np.float64], pattern: Pattern) -> NDArray[np.float64]:
    """Mean over the neighborhood of a pixel, of its cell's color, [H, W]: what the light and the lens do to it.

    It is the same for the pixels of a cell, so that a light that is not quite uniform does not look like polarization.
    """
    left, top = pattern.cell_corner()
    height, width = ((length - cut) // 2 for length, cut in zip(throughput.shape, (top, left), strict=True))
    inner = throughput[top : top + 2 * height, left : left + 2 * width]
    cells = inner.reshape(height, 2, width, 2).mean(axis=(1, 3))
    step = 1 if pattern.colors is None else 2
    for row, column in np.ndindex(step, step):
        plane = np.ascontiguousarray(cells[row::step, column::step])
        side = NEIGHBORHOOD if step == 1 else NEIGHBORHOOD // 2
        cells[row::step, column::step] = cv2.blur(plane, (side, side), borderType=cv2.BORDER_REFLECT)
    pixels = np.repeat(np.repeat(cells, 2, axis=0), 2, axis=1)
    # Pixels outside of whole cells, at odd edges, take what their neighbors have.
    after = [length - cut - 2 * count for length, cut, count in zip(throughput.shape, (top, left), (height, width), strict=True)]
    return np.pad(pixels, ((top, after[0]), (left, after[1])), mode="edge")
