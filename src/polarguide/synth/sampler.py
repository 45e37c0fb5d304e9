"""Random numbers of paths: a low-discrepancy sequence in the first dimensions, independent numbers after them."""

from __future__ import annotations

from typing import Any

_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41)
_WHOLE = 2**32


class Sampler:
    """Random numbers for one sample of each pixel.

    The first dimensions follow a Kronecker sequence with the square roots of primes, with a random shift per pixel and
    dimension (Cranley and Patterson 1976). Every single sample is uniform, so that estimates are unbiased.

    Args:
        pixel: index of the pixel.
        sample: index of the sample in its pixel, counted over all passes.
        seed: seed of the view, as Mitsuba's unsigned integer.

    Attributes:
        later: generator of independent numbers for the later dimensions.
    """

    def __init__(self, pixel: Any, sample: Any, seed: Any) -> None:
        import mitsuba as mi

        self._pixel, self._sample, self._seed = pixel, sample, seed
        self._used = 0
        state = mi.sample_tea_64(pixel, seed)
        self.later = mi.PCG32(1, state + mi.UInt64(sample), mi.UInt64(sample))

    def next(self) -> Any:
        """The next dimension of the sequence, in [0, 1)."""
        import drjit as dr
        import mitsuba as mi

        step = int((_PRIMES[self._used] ** 0.5 % 1) * _WHOLE)
        self._used += 1
        shift = mi.sample_tea_32(self._pixel, self._seed + mi.UInt32(self._used))[0]
        # In integers modulo 2^32, because floats lose digits as the index grows.
        turned = mi.UInt32((self._sample * mi.UInt32(step) + shift) & mi.UInt32(_WHOLE - 1))
        return dr.minimum(mi.Float(turned) * (1 / _WHOLE), 1 - 2.0**-24)

    def pair(self) -> Any:
        """The next two dimensions as a point."""
        import mitsuba as mi

        first = self.next()
        return mi.Point2f(first, self.next())
