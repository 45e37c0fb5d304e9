"""Radiometric levels: from sensor values to linear intensities, and the detection of unusable samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.errors import PolarguideError


@dataclass(frozen=True)
class Levels:
    """Radiometric levels of a capture, in stored values.

    Attributes:
        bits: bits of a sensor value.
        white: the value that becomes linear 1.
        saturation: the value from which a sample counts as saturated.
        black: the value without light.
        gamma: exponent of the stored values: stored = linear ^ gamma.
    """

    bits: int
    white: int
    saturation: int
    black: float
    gamma: float = 1.0

    def linear(self, values: NDArray[Any], dark: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """(value - black) / (white - black), made linear, float32; noise below black stays negative.

        Args:
            values: [..., H, W] stored values.
            dark: dark frame in stored values, in the same shape; it takes the place of the black level pixel by pixel.
        """
        floor = np.float32(self.black) if dark is None else dark
        shown = ((values.astype(np.float32) - floor) / np.float32(self.white - self.black)).astype(np.float32)
        if self.gamma == 1.0:
            return shown
        return np.asarray(np.copysign(np.abs(shown) ** np.float32(1 / self.gamma), shown))


def estimate_levels(
    largest: int, used: int, container: int, *, bits: int | None, black: float, saturation: int | None
) -> Levels:
    """Estimate the full scale of a capture.

    Without ``bits``: 8 in 8-bit files; in 16-bit files 12 if no value exceeds 4095 (the sensors' converters
    have 12 bits), else 16. Values whose low bits are never used (12 bits shifted to the top of 16) end at the
    last value that can occur.

    Args:
        largest: the largest stored value of the capture.
        used: bitwise or of all stored values.
        container: bits of the files' values, or of a packed pixel.
        bits: bits of a sensor value, or None.
        black: black level in stored values.
        saturation: stored value at which the sensor saturates, or None for full scale.

    Raises:
        PolarguideError: a value exceeds the range, or the levels are not in order.
    """
    if bits is None:
        bits = 12 if container == 16 and largest < 4096 else container
    if largest >= 1 << bits:
        raise PolarguideError(
            "--bits",
            expected=f"values below {1 << bits} for {bits} bits",
            found=str(largest),
            remedy="Give the number of bits that the files really use.",
        )
    white = (1 << bits) - 1
    unused = (used & -used).bit_length() - 1 if used else 0
    if bits == 16 and 0 < unused <= 8:
        white -= (1 << unused) - 1
    top = white if saturation is None else saturation
    if not 0 <= black < top <= white:
        raise PolarguideError(
            "--black-level" if not 0 <= black < white else "--saturation",
            expected=f"0 <= black level < saturation <= {white}",
            found=f"black level {black:g}, saturation {top}",
            remedy=f"Give both in stored values, for {bits} bits.",
        )
    return Levels(bits, white, top, float(black))


def unusable_samples(
    values: NDArray[Any], levels: Levels, dark: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Saturated and dark samples of a mosaic that starts with a whole polarizer cell.

    A sample is saturated from ``levels.saturation`` up. It is dark if it was cut off at 0 below a black level,
    or if none of the four samples of its 2x2 cell exceeds black: then there is no light whose polarization
    could be told. One angle at black beside brighter ones is kept, for that is what a surface at Brewster's
    angle looks like.

    Args:
        values: [H, W] stored values, H and W even.
        levels: of the capture.
        dark: dark frame in stored values, [H, W].

    Returns:
        Two masks [H, W].
    """
    height, width = values.shape
    floor = np.float32(levels.black) if dark is None else dark
    lit = (values > floor).reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3))
    black = np.repeat(np.repeat(~lit, 2, axis=0), 2, axis=1)
    if levels.black > 0 or dark is not None:
        black |= (values == 0) & (floor > 0)
    return np.asarray(values >= levels.saturation), black
