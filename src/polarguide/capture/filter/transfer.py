"""Decide by the pair sums whether pictures are linear or sRGB-encoded, and decode them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.filter.shots import Shots
from polarguide.capture.formats.pictures import TRANSFERS, linear_codes
from polarguide.capture.view import FULL_CODE

_CLEARLY = 0.9
_FEWEST = 1000
_LARGEST = 60_000


@dataclass(frozen=True)
class TransferDecision:
    """The chosen transfer function, and the reason."""

    transfer: str
    reason: str


def linear_intensities(pictures: NDArray[Any], transfer: str) -> NDArray[np.float32]:
    """Stored values -> linear intensities in [0, 1], same shape, float32."""
    return linear_codes(pictures, transfer).astype(np.float32) / np.float32(FULL_CODE)


def decide_transfer(shots: Sequence[Shots], *, jpeg: bool) -> TransferDecision:
    """The transfer under which I0 + I90 = I45 + I135 holds best.

    The pair sums of each view may differ by a common factor (exposure, gains): what counts is the median
    deviation from the view's median ratio, and the transfer has to be better than the other by a tenth.

    Args:
        shots: some views, aligned well enough (as from a tripod).
        jpeg: whether the files are JPEG, for the default where the pair sums do not decide.
    """
    deviations = dict.fromkeys(TRANSFERS, 0.0)
    count = 0
    for view in shots:
        usable = ~(view.clipped.any(axis=0) | view.dark)
        step = max(1, usable.size // _LARGEST)
        stored = view.pictures[:, usable][:, ::step]
        full = int(np.iinfo(stored.dtype).max)
        stored = stored[:, stored.min(axis=(0, 2)) > full // 50]
        if stored.shape[1] < _FEWEST:
            continue
        for transfer in TRANSFERS:
            i0, i45, i90, i135 = linear_intensities(stored, transfer).mean(axis=2, dtype=np.float64)
            ratio = (i0 + i90) / (i45 + i135)
            deviations[transfer] += float(np.median(np.abs(ratio / np.median(ratio) - 1.0))) * len(ratio)
        count += stored.shape[1]
    best = min(TRANSFERS, key=lambda name: deviations[name])
    if count and deviations[best] < _CLEARLY * max(deviations.values()):
        shares = ", ".join(f"{deviations[name] / count:.2%} as {name}" for name in TRANSFERS)
        return TransferDecision(best, f"{best}: pair sums deviate by {shares}")
    fallback = "srgb" if jpeg else "linear"
    kind = "JPEG files" if jpeg else "PNG and TIFF files"
    return TransferDecision(
        fallback, f"{fallback}, as {kind} usually are; the pair sums do not decide (--transfer sets it)"
    )
