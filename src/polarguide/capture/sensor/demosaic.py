"""Demosaic polarization mosaics, at full, half or quarter resolution."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.interpolate import (
    GUIDED_RADIUS,
    bilinear,
    bilinear_cells,
    guided_color,
    guided_polarization,
    used_by_bilinear,
)
from polarguide.capture.sensor.pattern import Pattern, tiled
from polarguide.capture.view import ANGLES

DEMOSAIC_MODES = {"half": 2, "quarter": 4, "full": 1}
"""Modes, and the sensor pixels that become one picture pixel, each way."""

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


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
