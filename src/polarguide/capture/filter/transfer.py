"""Decide by the four angles whether pictures are linear or sRGB-encoded, and decode them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture import checks
from polarguide.capture.filter.shots import Shots
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import Rounding, rounding_of
from polarguide.color import srgb_decode_array


@dataclass(frozen=True)
class TransferDecision:
    """The chosen transfer function, and the reason."""

    transfer: str
    reason: str


def linear_intensities(pictures: NDArray[Any], transfer: str) -> NDArray[np.float32]:
    """Stored values -> linear intensities in [0, 1], same shape, float32."""
    return linear_codes(pictures, transfer).astype(np.float32) / np.float32(FULL_CODE)


def rounding_of_bytes(transfer: str, smallest: float) -> Rounding:
    """What codes of 8-bit pictures are rounded to: by their steps, which grow with sRGB's.

    Args:
        transfer: "linear" or "srgb". smallest: factor of the linear intensities.
    """
    shown = np.arange(256) / 255
    return rounding_of(FULL_CODE * smallest * (srgb_decode_array(shown) if transfer == "srgb" else shown))


def decide_transfer(shots: Sequence[Shots], *, jpeg: bool) -> TransferDecision:
    """The transfer by the curvature of the response (``checks.encoding``), as ``inspect`` judges it.

    Args:
        shots: some views, aligned well enough (as from a tripod).
        jpeg: whether the files are JPEG, for the default where the curvature does not decide.
    """
    measures = [
        checks.measure(linear_codes(view.pictures, "linear"), ~(view.clipped.any(axis=0) | view.dark))
        for view in shots
    ]
    slope = checks.curvature(measures)
    found = checks.encoding(slope)
    said = "too few pixels are polarized to tell"
    if slope is not None:
        said = f"the curvature of the response is {slope:+.2f}; linear files have 0, sRGB about -0.6"
    if found is not None:
        return TransferDecision(found, f"{found}: {said}")
    fallback = "srgb" if jpeg else "linear"
    kind = "JPEG files" if jpeg else "PNG and TIFF files"
    return TransferDecision(fallback, f"{fallback}, as {kind} usually are: {said} (--transfer sets it)")
