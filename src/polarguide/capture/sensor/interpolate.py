"""Interpolate sparse samples: bilinear, or guided by edges, color differences and total intensity.

``guided_color`` interpolates green along the weaker gradient with a second-difference correction (after Hamilton
and Adams, US patent 5,629,734, expired; half of their correction, which overshoots less) and then the differences
of red and blue to green, which vary less than the colors. ``guided_polarization`` does the same across angles:
half of S0, which every 2x2 pixels hold completely, takes the part of green, so that edges of the picture do not
turn into polarization.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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
