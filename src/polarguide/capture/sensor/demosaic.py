"""Demosaic polarization mosaics at full, half or quarter resolution, and detect defective samples."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.pattern import Pattern, tiled
from polarguide.capture.view import ANGLES

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_TENT = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)
_HALVES = np.array([0.5, 1, 0.5], np.float32)


def interpolate_bilinear(values: Array, known: Mask) -> Array:
    """Interpolate samples bilinearly. The samples form a checkerboard, or are in every second row and column.

    Args:
        values: samples [H, W]. A value is ignored if ``known`` is False.
        known: mask of the samples, [H, W].

    Returns:
        [H, W]. The samples themselves do not change.
    """
    weight = _filtered(known.astype(np.float32))
    return np.where(known, values, _filtered(np.where(known, values, np.float32(0))) / weight)


def bilinear_cells(mosaic: Array, row: int, column: int, out: Array) -> None:
    """Interpolate the samples in every second row and every second column of a mosaic bilinearly.

    Args:
        mosaic: mosaic [H, W], H and W even.
        row: first row with samples, 0 or 1.
        column: first column with samples, 0 or 1.
        out: output [H, W].
    """
    spread = np.zeros_like(mosaic)
    spread[row::2, column::2] = mosaic[row::2, column::2]
    # Reflection about the outermost pixel continues the lattice, so that weights add up to 1.
    cv2.sepFilter2D(spread, -1, _HALVES, _HALVES, dst=out, borderType=cv2.BORDER_REFLECT_101)


def _filtered(values: Array) -> Array:
    return np.asarray(cv2.filter2D(values, -1, _TENT, borderType=cv2.BORDER_CONSTANT))


DEMOSAIC_MODES = {"half": 2, "quarter": 4, "full": 1}
"""Number of sensor pixels per pixel of the picture in each direction, for each mode of demosaicing."""


@dataclass(frozen=True, eq=False)
class DemosaicedPicture:
    """Result of demosaicing a raw mosaic.

    Attributes:
        intensities: linear intensities at 0, 45, 90 and 135 degrees, [4, h, w, 3] float32.
        invalid: mask of the pixels that were computed from an unusable sample, [h, w].
    """

    intensities: Array
    invalid: Mask


def demosaic(
    values: Array,
    bad: Mask,
    pattern: Pattern,
    *,
    mode: str,
    registered: bool = True,
    colored: bool = True,
) -> DemosaicedPicture:
    """Compute a picture at each of the four angles from a raw mosaic.

    - ``half``: each polarizer cell of 2 x 2 sensor pixels becomes one pixel. The cells of a color sensor form a Bayer
      picture for each angle, whose missing colors are interpolated.
    - ``quarter``: each square of 4 x 4 sensor pixels becomes one pixel. Its samples of the same angle and color are
      averaged, without interpolation.
    - ``full``: each sensor pixel becomes one pixel. Missing colors are interpolated between cells, then missing angles
      between neighboring pixels.

    The four samples of a cell are half a cell apart. If ``registered`` is True, the mode ``half`` interpolates all four
    angles at the center of the cell: it averages S1 and S2 of the mode ``full`` over the cell. S0 is taken from the
    samples of the cell, because the average would blur it.

    Args:
        values: linear intensities [H, W] after black level and gains.
        bad: mask of unusable samples, [H, W].
        pattern: pattern of the top-left pixel, which starts a whole polarizer cell.
        mode: a key of ``DEMOSAIC_MODES``.
        registered: if True, the mode ``half`` interpolates all four angles at the center of each cell.
        colored: if True, the result of a monochrome sensor has three equal channels. If False, it has one channel.

    Returns:
        The picture, of size ``H // s`` x ``W // s``, where s is 2, 4 or 1. Incomplete cells are left out.
    """
    invalid = spoiled(bad, pattern, mode=mode, registered=registered)
    step = 4 if mode == "quarter" else 2
    values = values[: values.shape[0] // step * step, : values.shape[1] // step * step]
    if mode == "quarter":
        picture = _superpixels(values, pattern)
    else:
        cells = _cells(values, pattern)
        if mode == "full":
            picture = _full(cells, pattern)
        else:
            places = {int(pattern.angles[place]): place for place in cells}
            picture = np.stack([cells[places[angle]] for angle in ANGLES])
            if registered:
                picture = _registered(picture, _full(cells, pattern))
    if colored and picture.shape[-1] == 1:
        picture = np.repeat(picture, 3, axis=-1)
    return DemosaicedPicture(picture, invalid)


def spoiled(bad: Mask, pattern: Pattern, *, mode: str, registered: bool = True) -> Mask:
    """Return a mask of the pixels that ``demosaic`` computes from an unusable sample.

    ``demosaic`` describes the arguments.
    """
    step = DEMOSAIC_MODES[mode]
    unit = 4 if mode == "quarter" else 2
    bad = bad[: bad.shape[0] // unit * unit, : bad.shape[1] // unit * unit]
    if not bad.any():
        return np.zeros((bad.shape[0] // step, bad.shape[1] // step), bool)
    if mode != "quarter":
        colored = np.empty_like(bad)
        for row, column in np.ndindex(2, 2):
            colored[row::2, column::2] = _spoiled_colors(bad, pattern, (row, column))
        # The 3x3 pixels around a pixel have all angles that it uses.
        all_angles = mode == "full" or registered
        bad = cv2.dilate(colored.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 if all_angles else colored
    return np.asarray(bad.reshape(bad.shape[0] // step, step, bad.shape[1] // step, step).any(axis=(1, 3)))


def _spoiled_colors(bad: Mask, pattern: Pattern, place: tuple[int, int]) -> Mask:
    """Return a mask of the colors that are computed from an unusable sample, for one angle of each cell."""
    row, column = place
    mask = bad[place[0] :: 2, place[1] :: 2]
    if pattern.colors is None:
        return mask
    bayer = tiled(pattern.colors[row::2, column::2], mask.shape)
    used = mask.copy()
    for color in range(3):
        known = bayer == color
        used |= ~known & (_filtered((mask & known).astype(np.float32)) > 0)
    return used


_Cells = dict[tuple[int, int], Array]
"""Picture [H/2, W/2, C] of the samples at each position (row, column) in the polarizer cells."""


def _cells(values: Array, pattern: Pattern) -> _Cells:
    colors: _Cells = {}
    for row, column in np.ndindex(2, 2):
        sample = values[row::2, column::2]
        if pattern.colors is None:
            colors[row, column] = sample[..., None]
            continue
        bayer = tiled(pattern.colors[row::2, column::2], sample.shape)
        colors[row, column] = np.stack(
            [interpolate_bilinear(sample, bayer == color) for color in range(3)], axis=-1
        )
    return colors


def _full(cells: _Cells, pattern: Pattern) -> Array:
    """Interpolate the missing angles at full size. Each color channel is treated like a monochrome mosaic."""
    height, width, channels = cells[0, 0].shape
    mosaic = np.empty((channels, 2 * height, 2 * width), np.float32)
    for (row, column), colors in cells.items():
        mosaic[:, row::2, column::2] = colors.transpose(2, 0, 1)
    at = {int(pattern.angles[place]): place for place in cells}
    # Planes by angle and channel; channels move to the end as a view.
    planes = np.empty((len(ANGLES), channels, 2 * height, 2 * width), np.float32)
    for channel, plane in enumerate(mosaic):
        for index, angle in enumerate(ANGLES):
            bilinear_cells(plane, *at[angle], out=planes[index, channel])
    return np.moveaxis(planes, 1, -1)


def _registered(plain: Array, full: Array) -> Array:
    """Return the intensities of the four angles at the centers of the cells.

    The full-size intensities are averaged over each cell.
    """
    angles, height, width, channels = plain.shape
    cells = full.reshape(angles, height, 2, width, 2, channels)
    upper, lower = (cells[:, :, row, :, 0] + cells[:, :, row, :, 1] for row in (0, 1))
    centered = np.asarray((upper + lower) / np.float32(4), np.float32)
    return centered + (plain.sum(axis=0) - centered.sum(axis=0)) / np.float32(4)


def _superpixels(values: Array, pattern: Pattern) -> Array:
    """Average the samples of the same angle and color in each square of 4 x 4 pixels."""
    repeat = 4 // pattern.period
    angles = np.tile(pattern.angles, (repeat, repeat))
    colors = None if pattern.colors is None else np.tile(pattern.colors, (repeat, repeat))
    rows = values.shape[0] // 4
    columns = values.shape[1] // 4
    blocks = values.reshape(rows, 4, columns, 4)
    picture = np.empty((4, rows, columns, 1 if colors is None else 3), np.float32)
    for index, angle in enumerate(ANGLES):
        for channel in range(picture.shape[3]):
            chosen = angles == angle if colors is None else (angles == angle) & (colors == channel)
            picture[index, ..., channel] = np.mean(
                [blocks[:, row, :, column] for row, column in np.argwhere(chosen)], axis=0, dtype=np.float32
            )
    return picture


_BEYOND_NOISE = 6.0
"""Smallest deviation of a defective sample, in standard deviations of the noise.

Among millions of samples, noise causes smaller deviations by chance.
"""
_OF_LIGHT = 0.5
"""Smallest rise of the two other angles of a cell if light causes the rise of a sample, relative to that rise.

A defect of the sample does not change the other angles.
"""
_BINS = 16
_AGREE = 0.5
"""Share of the mosaics in which a defective sample must be an outlier. Outliers by light differ between views."""
_SAME_SIGN = 0.75
"""Smallest net share of the mosaics in which a defective sample deviates in the same direction.

The net share is the share of mosaics with a positive deviation minus the share with a negative deviation, or the
reverse.
"""


def outliers(values: NDArray[Any], period: int) -> tuple[NDArray[np.bool_], NDArray[np.int8]]:
    """Find the samples of a mosaic that differ strongly from their neighbors.

    The neighbors are the eight nearest samples of the same angle and color. A sample is an outlier if its distance from
    their range is larger than this range and larger than the noise, while the other angles of its cell do not change.
    The noise is estimated from the mosaic as a function of brightness.

    Args:
        values: stored values [H, W] that start with a whole cell; sides are even.
        period: period of the pattern in pixels.

    Returns:
        The mask of the outliers; and for each sample the sign of its deviation from the median of the neighbors, which
        is 0 if the deviation is not significant. Both are [H, W].
    """
    height, width = values.shape
    padded = np.pad(values, period, mode="reflect")
    places = [
        (y, x) for y in (0, period, 2 * period) for x in (0, period, 2 * period) if (y, x) != (period, period)
    ]
    around = [padded[y : y + height, x : x + width] for y, x in places]
    for low, high in _NETWORK:
        a = around[low]
        b = around[high]
        around[low], around[high] = np.minimum(a, b), np.maximum(a, b)
    least = around[0].astype(np.float32)
    most = around[7].astype(np.float32)
    middle = (around[3].astype(np.float32) + around[4]) / 2
    del around
    spread = most - least
    rise = values - middle
    beyond = np.abs(rise) - np.maximum(most - middle, middle - least)
    off = np.abs(rise) > _BEYOND_NOISE * _noise(rise, middle)
    return np.asarray(off & (beyond > spread) & _is_isolated(rise)), (np.sign(rise) * off).astype(np.int8)


_NETWORK = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6),
    (0, 4), (1, 5), (2, 6), (3, 7), (2, 4), (3, 5), (1, 2), (3, 4), (5, 6),
)  # fmt: skip
"""Pairs of positions whose values are compared and exchanged to sort eight values (Batcher's odd-even merge sort).

Applied to whole pictures, this is faster than a sort at each pixel.
"""


def _noise(rise: NDArray[np.float32], middle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Estimate the standard deviation of the noise of each sample, which depends on its brightness."""
    step = max(1, rise.size >> 20)
    level = middle.ravel()[::step]
    deviation = np.abs(rise).ravel()[::step]
    edges = np.quantile(level, np.linspace(0, 1, _BINS + 1)).astype(np.float32)
    # A frequent brightness, such as black, gets a bin of its own, so it does not affect the noise of other values.
    common = edges[1:][np.diff(edges) == 0]
    edges = np.unique(np.concatenate((edges, np.nextafter(common, np.float32(np.inf)))))
    number = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, max(0, len(edges) - 2))
    bins = max(1, len(edges) - 1)
    sorted_deviation = deviation[np.argsort(number.astype(np.uint8), kind="stable")]  # by bin
    counts = np.bincount(number, minlength=bins)
    filled = counts > 0  # without the others, samples between two bins get the noise of the lower one
    medians = [float(np.median(each)) for each in np.split(sorted_deviation, np.cumsum(counts[filled])[:-1])]
    place = np.clip(np.searchsorted(edges[:bins][filled], middle, side="right") - 1, 0, None)
    # Rounding to whole numbers causes noise of a third of a step.
    return np.maximum(1.4826 * np.asarray(medians, np.float32), 1 / 3)[place]


def _is_isolated(rise: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of the samples that rise alone.

    The rise of such a sample is more than twice the common rise of the two angles of its cell that differ by 45
    degrees.
    """
    cell = [rise[row::2, column::2] for row, column in np.ndindex(2, 2)]
    # Analyzers at right angles are on the diagonals of a cell.
    others = {0: cell[1] + cell[2], 3: cell[1] + cell[2], 1: cell[0] + cell[3], 2: cell[0] + cell[3]}
    isolated = np.empty(rise.shape, bool)
    for number, (row, column) in enumerate(np.ndindex(2, 2)):
        own = cell[number]
        isolated[row::2, column::2] = np.sign(own) * others[number] < _OF_LIGHT * np.abs(own)
    return isolated


def defects(mosaics: Iterable[NDArray[Any]], period: int) -> NDArray[np.bool_]:
    """Return a mask [H, W] of the defective samples of a sensor.

    A defective sample is an outlier in at least half of the mosaics, and deviates in the same direction in nearly all.
    """
    votes: Any = 0
    signs: Any = 0
    count = 0
    for values in mosaics:
        out, sign = outliers(values, period)
        votes = np.add(votes, out, dtype=np.int32)
        signs = np.add(signs, sign, dtype=np.int32)
        count += 1
    return np.asarray((votes >= _AGREE * count) & (np.abs(signs) >= _SAME_SIGN * count))


def defects_note(count: int, samples: int) -> str:
    """Return a note for the user about the number of defective samples."""
    share = f"{count} samples ({count / samples:.3%})"
    return f"{share} differ from all similar neighbors (hot or dead pixels) and are invalid."
