"""Demosaic polarization mosaics at full, half or quarter resolution, and detect defective samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.pattern import Pattern, tiled
from polarguide.capture.view import ANGLES

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

GUIDED_RADIUS = 3
"""Largest distance in pixels at which a sample has influence in a guided interpolation: 2 for the guide, 1 beyond."""

_TENT = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)
_HALVES = np.array([0.5, 1, 0.5], np.float32)
_SOFT = np.float32(1e-2)
_SOFT_SQUARE = np.float32(1e-4)


def interpolate_bilinear(values: Array, known: Mask) -> Array:
    """Interpolate samples at every second pixel or in a checkerboard bilinearly.

    Args:
        values: samples [H, W]; ignored where ``known`` is False.
        known: mask of the samples, [H, W].

    Returns:
        [H, W]; known samples do not change.
    """
    weight = _filtered(known.astype(np.float32))
    return np.where(known, values, _filtered(np.where(known, values, np.float32(0))) / weight)


def bilinear_cells(mosaic: Array, row: int, column: int, out: Array) -> None:
    """Interpolate the samples at every second row from ``row`` and every second column from ``column``.

    Args:
        mosaic: mosaic [H, W], H and W even.
        row, column: 0 or 1.
        out: output [H, W].
    """
    spread = np.zeros_like(mosaic)
    spread[row::2, column::2] = mosaic[row::2, column::2]
    # Reflection about the outermost pixel continues the lattice, so that weights add up to 1.
    cv2.sepFilter2D(spread, -1, _HALVES, _HALVES, dst=out, borderType=cv2.BORDER_REFLECT_101)


def guided_color(bayer: Array, colors: NDArray[np.int64]) -> Array:
    """Interpolate a Bayer picture [H, W] with ``colors`` 0, 1, 2 (R, G, B) at its pixels to [H, W, 3]."""
    at = _neighbors(bayer)
    center = 2 * bayer
    bend_x = center - at(0, -2) - at(0, 2)
    bend_y = center - at(-2, 0) - at(2, 0)
    weight_x = 1 / ((np.abs(at(0, -1) - at(0, 1)) + np.abs(bend_x)) ** 2 + _SOFT_SQUARE)
    weight_y = 1 / ((np.abs(at(-1, 0) - at(1, 0)) + np.abs(bend_y)) ** 2 + _SOFT_SQUARE)
    along_x = (at(0, -1) + at(0, 1)) / 2 + bend_x / 8
    along_y = (at(-1, 0) + at(1, 0)) / 2 + bend_y / 8
    green = np.where(colors == 1, bayer, (along_x * weight_x + along_y * weight_y) / (weight_x + weight_y))
    red, blue = (green + interpolate_bilinear(bayer - green, colors == color) for color in (0, 2))
    return np.stack([red, green, blue], axis=-1).astype(np.float32)


def _half_s0(mosaic: Array) -> Array:
    """Estimate S0/2 at each pixel: mean of its four 2x2 windows, weighted against gradients toward them."""
    at = _neighbors(mosaic)
    total = np.zeros_like(mosaic)
    weights = np.zeros_like(mosaic)
    for down in (-1, 1):
        for right in (-1, 1):
            window = (mosaic + at(down, 0) + at(0, right) + at(down, right)) / 4
            # Only samples of one angle are compared. Other differences are polarization, not edges.
            outward = ((2 * down, 0), (0, 2 * right), (2 * down, 2 * right))
            across = ((down, 0), (0, right), (down, right))
            gradient = sum(np.abs(at(y, x) - mosaic) for y, x in outward)
            gradient += sum(np.abs(at(y, x) - at(-y, -x)) for y, x in across) / 2
            weight = 1 / (gradient + _SOFT)
            total += weight * window
            weights += weight
    return total / weights


def _neighbors(values: Array) -> Callable[[int, int], Array]:
    """Return a function of (y, x) that shifts the picture: the value ``y`` pixels below and ``x`` to the right."""
    height, width = values.shape
    # Reflection about the outermost pixel continues the pattern.
    padded = cv2.copyMakeBorder(values, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)

    def at(y: int, x: int) -> Array:
        return np.asarray(padded[2 + y : 2 + y + height, 2 + x : 2 + x + width])

    return at


def _filtered(values: Array) -> Array:
    return np.asarray(cv2.filter2D(values, -1, _TENT, borderType=cv2.BORDER_CONSTANT))


DEMOSAIC_MODES = {"half": 2, "quarter": 4, "full": 1}
"""Sensor pixels per picture pixel in each direction, by mode."""


@dataclass(frozen=True, eq=False)
class DemosaicedPicture:
    """Demosaiced intensities.

    Attributes:
        intensities: linear intensities at 0, 45, 90 and 135 degrees, [4, h, w, 3] float32.
        invalid: mask of pixels that use an unusable sample, [h, w].
    """

    intensities: Array
    invalid: Mask


def demosaic(
    values: Array,
    bad: Mask,
    pattern: Pattern,
    *,
    mode: str,
    interpolation: str,
    registered: bool = True,
    colored: bool = True,
) -> DemosaicedPicture:
    """Demosaic one mosaic.

    ``half``: each 2x2 polarizer cell is one pixel; the cells of a color sensor form a Bayer picture per angle.
    ``quarter``: each 4x4 superpixel is one pixel, the mean of its samples of an angle and color, without interpolation.
    ``full``: every sensor pixel; colors are interpolated between cells of one angle, then angles between neighboring
    pixels.

    The four samples of a cell are half a cell apart. If ``registered``, ``half`` interpolates them at its center: S1
    and S2 are means over the cell in ``full``, and so is S0 of guided interpolation. Bilinear interpolation would blur
    S0, which is that of the cell's own samples.

    Args:
        values: linear intensities [H, W] after black level and gains.
        bad: mask of unusable samples, [H, W].
        pattern: pattern of the top-left pixel, which starts a whole polarizer cell.
        mode: a key of ``DEMOSAIC_MODES``.
        interpolation: ``bilinear`` or ``guided``; ``quarter`` and a monochrome ``half`` interpolate no colors.
        registered: if True, ``half`` moves the four angles to one place.
        colored: if True, a monochrome sensor gives three equal channels, else one channel.

    Returns:
        The picture of size ``H // s`` x ``W // s`` for s = 2, 4 or 1, without incomplete cells.
    """
    invalid = spoiled(bad, pattern, mode=mode, interpolation=interpolation, registered=registered)
    step = 4 if mode == "quarter" else 2
    values = values[: values.shape[0] // step * step, : values.shape[1] // step * step]
    if mode == "quarter":
        picture = _superpixels(values, pattern)
    else:
        cells = _cells(values, pattern, interpolation)
        if mode == "full":
            picture = _full(cells, pattern, interpolation)
        else:
            places = {int(pattern.angles[place]): place for place in cells}
            picture = np.stack([cells[places[angle]] for angle in ANGLES])
            if registered:
                picture = _registered(picture, _full(cells, pattern, interpolation), interpolation)
    if colored and picture.shape[-1] == 1:
        picture = np.repeat(picture, 3, axis=-1)
    return DemosaicedPicture(picture, invalid)


def spoiled(bad: Mask, pattern: Pattern, *, mode: str, interpolation: str, registered: bool = True) -> Mask:
    """Return a mask of the pixels for which ``demosaic`` uses an unusable sample; arguments are the same."""
    step = DEMOSAIC_MODES[mode]
    unit = 4 if mode == "quarter" else 2
    bad = bad[: bad.shape[0] // unit * unit, : bad.shape[1] // unit * unit]
    if not bad.any():
        return np.zeros((bad.shape[0] // step, bad.shape[1] // step), bool)
    if mode != "quarter":
        colored = np.empty_like(bad)
        for row, column in np.ndindex(2, 2):
            colored[row::2, column::2] = _spoiled_colors(bad, pattern, (row, column), interpolation)
        # The 3x3 pixels around a pixel have all angles that it uses.
        full = _dilated(colored, 1 if interpolation == "bilinear" else GUIDED_RADIUS)
        bad = full if mode == "full" else colored | full if registered else colored
    return np.asarray(bad.reshape(bad.shape[0] // step, step, bad.shape[1] // step, step).any(axis=(1, 3)))


def _spoiled_colors(bad: Mask, pattern: Pattern, place: tuple[int, int], interpolation: str) -> Mask:
    """Return a mask of the colors at one place of the cells that use an unusable sample."""
    row, column = place
    mask = bad[place[0] :: 2, place[1] :: 2]
    if pattern.colors is None:
        return mask
    if interpolation != "bilinear":
        return _dilated(mask, GUIDED_RADIUS)
    bayer = tiled(pattern.colors[row::2, column::2], mask.shape)
    used = mask.copy()
    for color in range(3):
        known = bayer == color
        used |= ~known & (_filtered((mask & known).astype(np.float32)) > 0)
    return used


_Cells = dict[tuple[int, int], Array]
"""Colors [H/2, W/2, C] by position (row, column) in the cell."""


def _cells(values: Array, pattern: Pattern, interpolation: str) -> _Cells:
    colors: _Cells = {}
    for row, column in np.ndindex(2, 2):
        sample = values[row::2, column::2]
        if pattern.colors is None:
            colors[row, column] = sample[..., None]
            continue
        bayer = tiled(pattern.colors[row::2, column::2], sample.shape)
        if interpolation == "bilinear":
            colors[row, column] = np.stack(
                [interpolate_bilinear(sample, bayer == color) for color in range(3)], axis=-1
            )
        else:
            colors[row, column] = guided_color(sample, bayer)
    return colors


def _full(cells: _Cells, pattern: Pattern, interpolation: str) -> Array:
    """Interpolate angles at full size. Each channel is like the mosaic of a monochrome sensor."""
    height, width, channels = cells[0, 0].shape
    mosaic = np.empty((channels, 2 * height, 2 * width), np.float32)
    for (row, column), colors in cells.items():
        mosaic[:, row::2, column::2] = colors.transpose(2, 0, 1)
    at = {int(pattern.angles[place]): place for place in cells}
    # Planes by angle and channel; channels move to the end as a view.
    planes = np.empty((len(ANGLES), channels, 2 * height, 2 * width), np.float32)
    for channel, plane in enumerate(mosaic):
        if interpolation == "bilinear":
            for index, angle in enumerate(ANGLES):
                bilinear_cells(plane, *at[angle], out=planes[index, channel])
        else:
            guide = _half_s0(plane)
            places = tiled(pattern.angles[:2, :2], plane.shape)
            for index, angle in enumerate(ANGLES):
                planes[index, channel] = guide + interpolate_bilinear(plane - guide, places == angle)
    return np.moveaxis(planes, 1, -1)


def _registered(plain: Array, full: Array, interpolation: str) -> Array:
    """Average full-size angles over cells, so that all are at the centers of the cells."""
    angles, height, width, channels = plain.shape
    cells = full.reshape(angles, height, 2, width, 2, channels)
    upper, lower = (cells[:, :, row, :, 0] + cells[:, :, row, :, 1] for row in (0, 1))
    centered = np.asarray((upper + lower) / np.float32(4), np.float32)
    if interpolation == "bilinear":
        centered += (plain.sum(axis=0) - centered.sum(axis=0)) / np.float32(4)
    return centered


def _superpixels(values: Array, pattern: Pattern) -> Array:
    """Average the samples of one angle and color in each 4x4 pixels."""
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


def _dilated(mask: Mask, radius: int) -> Mask:
    if not mask.any():
        return mask
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


_BEYOND_NOISE = 6.0
"""Threshold in standard deviations of the sensor's noise. Some of millions of samples exceed less by chance."""
_OF_LIGHT = 0.5
"""Smallest joint rise of the analyzers at 45 degrees, relative to a rise by light. A defect causes none."""
_BINS = 16
_AGREE = 0.5
"""Share of the views in which a defect must be an outlier. Light changes from view to view; defects do not."""
_SAME_SIGN = 0.75
"""Share of the views in which a defect must be on one side: views above minus views below."""


def outliers(values: NDArray[Any], period: int) -> tuple[NDArray[np.bool_], NDArray[np.int8]]:
    """Find the outliers of one mosaic, [H, W], and the sign of significant differences from the median of neighbors.

    Neighbors are the eight nearest samples behind the same analyzer and color. A sample is an outlier if it exceeds
    their range by more than this range and by more than noise, while the other analyzers of its cell do not change. The
    noise
    is that of the sensor at this brightness: the median deviation of samples from the median of their neighbors.

    Args:
        values: stored values [H, W] that start with a whole cell; sides are even.
        period: period of the pattern in pixels.
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
"""Comparisons that sort eight values (Batcher's odd-even merge sort), faster on whole pictures than sorting pixels."""


def _noise(rise: NDArray[np.float32], middle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the standard deviation of the noise of each sample by brightness."""
    step = max(1, rise.size >> 20)
    level = middle.ravel()[::step]
    deviation = np.abs(rise).ravel()[::step]
    edges = np.quantile(level, np.linspace(0, 1, _BINS + 1)).astype(np.float32)
    # A frequent brightness, such as black, is a bin of its own, because it has no influence on the noise of others.
    common = edges[1:][np.diff(edges) == 0]
    edges = np.unique(np.concatenate((edges, np.nextafter(common, np.float32(np.inf)))))
    number = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, max(0, len(edges) - 2))
    bins = max(1, len(edges) - 1)
    sorted_deviation = deviation[np.argsort(number.astype(np.uint8), kind="stable")]  # by bin
    ends = np.cumsum(np.bincount(number, minlength=bins))
    medians = [float(np.median(each)) for each in np.split(sorted_deviation, ends[:-1])]
    place = np.clip(np.searchsorted(edges, middle, side="right") - 1, 0, len(medians) - 1)
    # Rounding to whole numbers causes noise of a third of a step.
    return np.maximum(1.4826 * np.asarray(medians, np.float32), 1 / 3)[place]


def _is_isolated(rise: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of samples whose rise is more than double the joint rise of the analyzers at 45 degrees."""
    cell = [rise[row::2, column::2] for row, column in np.ndindex(2, 2)]
    # Analyzers at right angles are on the diagonals of a cell.
    others = {0: cell[1] + cell[2], 3: cell[1] + cell[2], 1: cell[0] + cell[3], 2: cell[0] + cell[3]}
    isolated = np.empty(rise.shape, bool)
    for number, (row, column) in enumerate(np.ndindex(2, 2)):
        own = cell[number]
        isolated[row::2, column::2] = np.sign(own) * others[number] < _OF_LIGHT * np.abs(own)
    return isolated


def defects(mosaics: Iterable[NDArray[Any]], period: int) -> NDArray[np.bool_]:
    """Return a mask [H, W] of samples that are outliers in half of the mosaics and differ in nearly all."""
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
    """Return a note for the user on the number of defects among the samples of a mosaic."""
    share = f"{count} samples ({count / samples:.3%})"
    return f"{share} differ from all similar neighbors (hot or dead pixels) and are invalid."
