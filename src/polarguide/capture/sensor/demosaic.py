"""Demosaic polarization mosaics, at full, half or quarter resolution; find defective samples (hot and dead pixels)."""

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

GUIDED_RADIUS = 3
"""Pixels around a sample that its value reaches in either guided interpolation: 2 for the guide, 1 beyond."""

_TENT = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)
_HALVES = np.array([0.5, 1, 0.5], np.float32)
_SOFT = np.float32(1e-2)
_SOFT_SQUARE = np.float32(1e-4)


def bilinear(values: Array, known: Mask) -> Array:
    """Bilinear interpolation of samples that are known at every second pixel, or in a checkerboard.

    Args:
        values: [H, W]; those where ``known`` is False are not looked at.
        known: [H, W].

    Returns:
        [H, W], the samples themselves where they are known.
    """
    weight = _filtered(known.astype(np.float32))
    return np.where(known, values, _filtered(np.where(known, values, np.float32(0))) / weight)


def used_by_bilinear(bad: Mask, known: Mask) -> Mask:
    """Where ``bilinear`` uses a bad sample."""
    if not bad.any():
        return np.zeros_like(bad)
    return np.where(known, bad, _filtered((bad & known).astype(np.float32)) > 0)


def bilinear_cells(mosaic: Array, row: int, column: int, out: Array) -> None:
    """``bilinear`` of the samples at rows ``row``, ``row + 2``, ... and columns ``column``, ``column + 2``, ...

    Args:
        mosaic: [H, W], H and W even. row, column: 0 or 1. out: [H, W], takes the result.
    """
    spread = np.zeros_like(mosaic)
    spread[row::2, column::2] = mosaic[row::2, column::2]
    # Reflected about the outermost pixel the lattice goes on, and the weights add up to 1 everywhere.
    cv2.sepFilter2D(spread, -1, _HALVES, _HALVES, dst=out, borderType=cv2.BORDER_REFLECT_101)


def guided_color(bayer: Array, colors: NDArray[np.int64]) -> Array:
    """Bayer picture [H, W] with ``colors`` 0, 1, 2 (R, G, B) at its pixels -> [H, W, 3]."""
    at = _Neighbors(bayer)
    center = 2 * bayer
    bend_x, bend_y = center - at(0, -2) - at(0, 2), center - at(-2, 0) - at(2, 0)
    weight_x = 1 / ((np.abs(at(0, -1) - at(0, 1)) + np.abs(bend_x)) ** 2 + _SOFT_SQUARE)
    weight_y = 1 / ((np.abs(at(-1, 0) - at(1, 0)) + np.abs(bend_y)) ** 2 + _SOFT_SQUARE)
    along_x = (at(0, -1) + at(0, 1)) / 2 + bend_x / 8
    along_y = (at(-1, 0) + at(1, 0)) / 2 + bend_y / 8
    between = (along_x * weight_x + along_y * weight_y) / (weight_x + weight_y)
    green = np.where(colors == 1, bayer, between)
    red, blue = (green + bilinear(bayer - green, colors == color) for color in (0, 2))
    return np.stack([red, green, blue], axis=-1).astype(np.float32)


def guided_polarization(mosaic: Array, places: NDArray[np.int64]) -> Array:
    """Monochrome polarization mosaic [H, W] with angles ``places`` in degrees -> [4, H, W] by angle."""
    guide = _half_s0(mosaic)
    difference = mosaic - guide
    return np.stack([guide + bilinear(difference, places == angle) for angle in ANGLES])


def _half_s0(mosaic: Array) -> Array:
    """S0/2 at each pixel: mean of the four 2x2 windows it belongs to, weighted against gradients toward them."""
    at = _Neighbors(mosaic)
    total, weights = np.zeros_like(mosaic), np.zeros_like(mosaic)
    for down in (-1, 1):
        for right in (-1, 1):
            window = (mosaic + at(down, 0) + at(0, right) + at(down, right)) / 4
            # Only samples of one angle are compared: others differ by polarization, not by edges.
            outward = ((2 * down, 0), (0, 2 * right), (2 * down, 2 * right))
            across = ((down, 0), (0, right), (down, right))
            gradient = sum(np.abs(at(y, x) - mosaic) for y, x in outward)
            gradient += sum(np.abs(at(y, x) - at(-y, -x)) for y, x in across) / 2
            weight = 1 / (gradient + _SOFT)
            total += weight * window
            weights += weight
    return total / weights


class _Neighbors:
    """``at(y, x)``: the picture moved so that each pixel sees the one ``y`` below and ``x`` to the right of it."""

    def __init__(self, values: Array) -> None:
        self._shape = values.shape
        # Reflected about the outermost pixel, so that the pattern goes on.
        self._padded = cv2.copyMakeBorder(values, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)

    def __call__(self, y: int, x: int) -> Array:
        height, width = self._shape
        return np.asarray(self._padded[2 + y : 2 + y + height, 2 + x : 2 + x + width])


def _filtered(values: Array) -> Array:
    return np.asarray(cv2.filter2D(values, -1, _TENT, borderType=cv2.BORDER_CONSTANT))


DEMOSAIC_MODES = {"half": 2, "quarter": 4, "full": 1}
"""Modes, and the sensor pixels that become one picture pixel, each way."""


@dataclass(frozen=True, eq=False)
class DemosaicedPicture:
    """Demosaiced intensities.

    Attributes:
        intensities: [4, h, w, 3] float32, linear, for 0, 45, 90 and 135 degrees.
        invalid: pixels for which an unusable sample was used, [h, w].
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
    ``quarter``: each 4x4 superpixel is one pixel, the mean of its samples of an angle and color; nothing is
    interpolated. ``full``: every sensor pixel; colors are interpolated between cells of one angle, then angles
    between neighboring pixels.

    The four samples of a cell lie half a cell apart. ``half`` brings them to its center if ``registered``: S1 and S2
    are means over the cell of what ``full`` makes of it, and so is S0 if interpolation is guided; bilinear
    interpolation would only blur S0, which is that of the cell's own samples.

    Args:
        values: linear intensities [H, W], black level and gains already applied.
        bad: unusable samples, [H, W].
        pattern: of the top-left pixel, which starts a whole polarizer cell.
        mode: a key of ``DEMOSAIC_MODES``.
        interpolation: ``bilinear`` or ``guided``; ``quarter`` and a monochrome ``half`` interpolate no colors.
        registered: whether ``half`` brings the four angles to one place.
        colored: whether a monochrome sensor gives three equal channels; else it gives one.

    Returns:
        The picture, of size ``H // s`` x ``W // s`` for s = 2, 4 or 1 (what fills no cell is cut).
    """
    step = 4 if mode == "quarter" else 2
    height, width = values.shape[0] // step * step, values.shape[1] // step * step
    values, bad = values[:height, :width], bad[:height, :width]
    if mode == "quarter":
        found = _superpixels(values, bad, pattern)
    else:
        cells = _cells(values, bad, pattern, interpolation)
        if mode == "full":
            found = _full(cells, pattern, interpolation)
        else:
            found = _half_size(cells, pattern)
            if registered:
                found = _registered(found, _full(cells, pattern, interpolation), interpolation)
    if colored and found.intensities.shape[-1] == 1:
        return DemosaicedPicture(np.repeat(found.intensities, 3, axis=-1), found.invalid)
    return found


@dataclass(frozen=True, eq=False)
class _Cells:
    """Colors at every sensor pixel: position (row, column) in the cell -> [H/2, W/2, C], and what is bad."""

    colors: dict[tuple[int, int], Array]
    bad: dict[tuple[int, int], Mask]


def _cells(values: Array, bad: Mask, pattern: Pattern, interpolation: str) -> _Cells:
    colors: dict[tuple[int, int], Array] = {}
    wrong: dict[tuple[int, int], Mask] = {}
    for row, column in np.ndindex(2, 2):
        sample, mask = values[row::2, column::2], bad[row::2, column::2]
        if pattern.colors is None:
            colors[row, column], wrong[row, column] = sample[..., None], mask
            continue
        bayer = tiled(pattern.colors[row::2, column::2], sample.shape)
        if interpolation == "bilinear":
            planes = [bilinear(sample, bayer == color) for color in range(3)]
            uses = [used_by_bilinear(mask, bayer == color) for color in range(3)]
            colors[row, column] = np.stack(planes, axis=-1)
            wrong[row, column] = np.any(uses, axis=0)
        else:
            colors[row, column] = guided_color(sample, bayer)
            wrong[row, column] = _dilated(mask, GUIDED_RADIUS)
    return _Cells(colors, wrong)


def _half_size(cells: _Cells, pattern: Pattern) -> DemosaicedPicture:
    """Half size: the samples of a cell, by angle."""
    angles = {int(pattern.angles[place]): place for place in cells.colors}
    stack = np.stack([cells.colors[angles[angle]] for angle in ANGLES])
    return DemosaicedPicture(stack, np.any(list(cells.bad.values()), axis=0))


def _full(cells: _Cells, pattern: Pattern, interpolation: str) -> DemosaicedPicture:
    """Full size: each channel is the mosaic of a monochrome polarization sensor."""
    height, width, channels = cells.colors[0, 0].shape
    mosaic = np.empty((channels, 2 * height, 2 * width), np.float32)
    bad = np.empty((2 * height, 2 * width), bool)
    for (row, column), colors in cells.colors.items():
        mosaic[:, row::2, column::2], bad[row::2, column::2] = (
            colors.transpose(2, 0, 1),
            cells.bad[row, column],
        )
    at = {int(pattern.angles[place]): place for place in cells.colors}
    # A plane of every angle and channel in turn; the channels come last only as they are looked at.
    planes = np.empty((len(ANGLES), channels, 2 * height, 2 * width), np.float32)
    for channel, plane in enumerate(mosaic):
        if interpolation == "bilinear":
            for index, angle in enumerate(ANGLES):
                bilinear_cells(plane, *at[angle], out=planes[index, channel])
        else:
            planes[:, channel] = guided_polarization(plane, tiled(pattern.angles[:2, :2], bad.shape))
    # Around every pixel the 3x3 pixels hold what is used of all angles.
    invalid = _dilated(bad, 1 if interpolation == "bilinear" else GUIDED_RADIUS)
    return DemosaicedPicture(np.moveaxis(planes, 1, -1), invalid)


def _registered(plain: DemosaicedPicture, full: DemosaicedPicture, interpolation: str) -> DemosaicedPicture:
    """Half size, all angles at the centers of the cells."""
    angles, height, width, channels = plain.intensities.shape
    cells = full.intensities.reshape(angles, height, 2, width, 2, channels)
    centered = cells.mean(axis=(2, 4), dtype=np.float32)
    if interpolation == "bilinear":
        centered += (plain.intensities.sum(axis=0) - centered.sum(axis=0)) / np.float32(4)
    invalid = full.invalid.reshape(height, 2, width, 2).any(axis=(1, 3))
    return DemosaicedPicture(centered, np.asarray(plain.invalid | invalid))


def _superpixels(values: Array, bad: Mask, pattern: Pattern) -> DemosaicedPicture:
    """Quarter size: means over the samples of one angle and color in each 4x4 pixels."""
    repeat = 4 // pattern.period
    angles = np.tile(pattern.angles, (repeat, repeat))
    colors = None if pattern.colors is None else np.tile(pattern.colors, (repeat, repeat))
    rows, columns = values.shape[0] // 4, values.shape[1] // 4
    blocks = values.reshape(rows, 4, columns, 4)
    picture = np.empty((4, rows, columns, 1 if colors is None else 3), np.float32)
    for index, angle in enumerate(ANGLES):
        for channel in range(picture.shape[3]):
            chosen = angles == angle if colors is None else (angles == angle) & (colors == channel)
            samples = [blocks[:, row, :, column] for row, column in np.argwhere(chosen)]
            picture[index, ..., channel] = np.mean(samples, axis=0, dtype=np.float32)
    return DemosaicedPicture(picture, np.asarray(bad.reshape(rows, 4, columns, 4).any(axis=(1, 3))))


def _dilated(mask: Mask, radius: int) -> Mask:
    if not mask.any():
        return mask
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


_BEYOND_NOISE = 6.0
"""Standard deviations of the sensor's own noise: less happens by chance in some of millions of samples."""
_OF_LIGHT = 0.5
"""Light that raises one analyzer raises the two at 45 degrees to it by as much together; a defect does not."""
_BINS = 16
_AGREE, _SAME_SIGN = 0.5, 0.75
"""Shares of the views in which a sample has to stand out, and to lie on one side (views above less views below): light
moves from view to view, defects stay."""


def outliers(values: NDArray[Any], period: int) -> tuple[NDArray[np.bool_], NDArray[np.int8]]:
    """Samples of one mosaic that stand out from all alike, [H, W]; and where samples lie above (1) or below (-1) the
    median of those alike by more than noise explains.

    A sample stands out if it lies beyond its eight neighbors behind one analyzer and color by more than these differ
    among themselves and than noise explains, while the other analyzers of its cell see nothing of it. The noise is that
    of the sensor at that brightness: the median deviation of samples from the median of their neighbors.

    Args:
        values: [H, W] stored values, beginning with a whole cell; sides are even.
        period: pixels after which the pattern repeats.
    """
    height, width = values.shape
    padded = np.pad(values, period, mode="reflect")
    places = [
        (y, x) for y in (0, period, 2 * period) for x in (0, period, 2 * period) if (y, x) != (period, period)
    ]
    around = _sorted([padded[y : y + height, x : x + width] for y, x in places])
    least, most = around[0].astype(np.float32), around[7].astype(np.float32)
    middle = (around[3].astype(np.float32) + around[4]) / 2
    del around
    spread = most - least
    rise = values - middle
    beyond = np.abs(rise) - np.maximum(most - middle, middle - least)
    noise = _noise(rise, middle)
    off = np.abs(rise) > _BEYOND_NOISE * noise
    return np.asarray(off & (beyond > spread) & _alone(rise)), (np.sign(rise) * off).astype(np.int8)


_NETWORK = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6),
    (0, 4), (1, 5), (2, 6), (3, 7), (2, 4), (3, 5), (1, 2), (3, 4), (5, 6),
)  # fmt: skip
"""Comparisons that sort eight values (Batcher's odd-even merge sort): on whole pictures, faster than a sort of each
pixel."""


def _sorted(eight: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Eight pictures, sorted at every pixel."""
    for low, high in _NETWORK:
        a, b = eight[low], eight[high]
        eight[low], eight[high] = np.minimum(a, b), np.maximum(a, b)
    return eight


def _noise(rise: NDArray[np.float32], middle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard deviation of the noise of each sample, by brightness."""
    step = max(1, rise.size >> 20)
    level, deviation = middle.ravel()[::step], np.abs(rise).ravel()[::step]
    edges = np.quantile(level, np.linspace(0, 1, _BINS + 1)).astype(np.float32)
    # One brightness of many samples, such as black, is a bin of its own: it says nothing of the noise of others.
    common = edges[1:][np.diff(edges) == 0]
    edges = np.unique(np.concatenate((edges, np.nextafter(common, np.float32(np.inf)))))
    number = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, max(0, len(edges) - 2))
    medians = [float(np.median(deviation[number == k])) for k in range(max(1, len(edges) - 1))]
    place = np.clip(np.searchsorted(edges, middle, side="right") - 1, 0, len(medians) - 1)
    # Whole numbers are rounded: no noise is less than a third of a step.
    return np.maximum(1.4826 * np.asarray(medians, np.float32), 1 / 3)[place]


def _alone(rise: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether the analyzers at 45 degrees to a sample's rise or fall together by less than half of what it does."""
    cell = [rise[row::2, column::2] for row, column in np.ndindex(2, 2)]
    # Analyzers at right angles lie along the diagonals of a cell.
    beside = {0: cell[1] + cell[2], 3: cell[1] + cell[2], 1: cell[0] + cell[3], 2: cell[0] + cell[3]}
    alone = np.empty(rise.shape, bool)
    for number, (row, column) in enumerate(np.ndindex(2, 2)):
        mine = cell[number]
        alone[row::2, column::2] = np.sign(mine) * beside[number] < _OF_LIGHT * np.abs(mine)
    return alone


def defects(mosaics: Iterable[NDArray[Any]], period: int) -> NDArray[np.bool_]:
    """The samples that stand out in at least half of the mosaics of a capture and are off in nearly all, [H, W]."""
    votes: NDArray[np.int32] | None = None
    signs: NDArray[np.int32] | None = None
    count = 0
    for values in mosaics:
        out, sign = outliers(values, period)
        votes = out.astype(np.int32) if votes is None else votes + out
        signs = sign.astype(np.int32) if signs is None else signs + sign
        count += 1
    assert votes is not None
    assert signs is not None
    return np.asarray((votes >= _AGREE * count) & (np.abs(signs) >= _SAME_SIGN * count))


def defects_note(count: int, samples: int) -> str:
    """What to tell the user of so many defects among all samples of a mosaic."""
    share = f"{count} samples ({count / samples:.3%})"
    return f"{share} stand out from all alike beside them (hot or dead pixels): invalid."
