"""Defective samples of a sensor (hot and dead pixels), found by their neighbors behind the same analyzer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    bins = max(1, len(edges) - 1)
    together = deviation[np.argsort(number.astype(np.uint8), kind="stable")]  # by bin
    ends = np.cumsum(np.bincount(number, minlength=bins))
    medians = [float(np.median(each)) for each in np.split(together, ends[:-1])]
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
