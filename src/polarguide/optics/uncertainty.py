"""Standard deviations of DoLP and AoLP from the noise of the four intensities, and what noise adds to the DoLP.

First-order propagation: with P = sqrt(S1^2 + S2^2), c = S1 / P, s = S2 / P and d = P / S0, a change dI of the four
intensities changes

    d    by ((c - d/2) dI0 + (s - d/2) dI45 - (c + d/2) dI90 - (s + d/2) dI135) / S0,
    AoLP by (-s dI0 + c dI45 + s dI90 - c dI135) / (2 P),

and independent noise adds in squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.optics._arrays import for_arrays
from polarguide.optics._numerics import check_leading

UNIFORM_SPREAD = math.pi / math.sqrt(12.0)
"""Standard deviation of an angle about which nothing is known, in radians (52 degrees)."""


class Uncertainty(NamedTuple):
    """How well DoLP and AoLP are known.

    Attributes:
        dolp: [...] standard deviation of the DoLP; infinite where S0 <= 0.
        aolp: [...] standard deviation of the AoLP, radians, at most ``UNIFORM_SPREAD``.
        debiased: [...] DoLP in [0, 1] without what noise adds to it on average.
    """

    dolp: Tensor
    aolp: Tensor
    debiased: Tensor


@for_arrays
def polarization_uncertainty(stokes: Tensor, variances: Tensor) -> Uncertainty:
    """Standard deviations of DoLP and AoLP, and the DoLP debiased.

    Noise makes a DoLP larger: unpolarized light measures as noise does. The debiased DoLP is the modified asymptotic
    estimator ``d - b^2 (1 - exp(-d^2 / b^2)) / (2 d)`` with b the noise across the direction of polarization
    (Plaszczynski, Montier, Levrier and Tristram 2014, "A novel estimator of the polarization amplitude from normally
    distributed Stokes parameters", MNRAS 439, 4048), which is unbiased from about d = 2 b on. Of
    unpolarized light it leaves four fifths of what noise makes: over a region, average Stokes vectors instead.

    Args:
        stokes: [3, ...].
        variances: [4, ...] of the four intensities in the order of ``ANGLES``, independent, squared units of
            ``stokes``; or a shape that broadcasts to it.

    Returns:
        Uncertainty. To first order: good where the DoLP is over about three times its standard deviation. Without
        any polarization the AoLP has ``UNIFORM_SPREAD``, and the spread of the DoLP is 0.66 of what is stated.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3 or that of ``variances`` not 4.
    """
    check_leading(stokes, 3, "stokes")
    check_leading(variances, 4, "variances")
    s0, s1, s2 = stokes.unbind(0)
    v0, v45, v90, v135 = variances.unbind(0)
    tiny = torch.finfo(s0.dtype).tiny
    lit = s0 > tiny
    square = s1 * s1 + s2 * s2
    polarized = square > tiny
    inverse = torch.where(polarized, square, 1.0).rsqrt()
    # Without polarization any direction will do: the first.
    c, s = torch.where(polarized, s1 * inverse, 1.0), s2 * inverse
    scale = 1 / torch.where(lit, s0, 1.0)
    d = (torch.where(polarized, square * inverse, 0.0) * scale).clamp(max=1)
    half = d / 2
    along = (c - half) ** 2 * v0 + (s - half) ** 2 * v45 + (c + half) ** 2 * v90 + (s + half) ** 2 * v135
    across = s * s * (v0 + v90) + c * c * (v45 + v135)
    b2 = across * scale * scale
    ratio = (d * d / b2.clamp(min=tiny)).clamp(max=88.0)
    removed = b2 * -torch.expm1(-ratio) / (2 * d.clamp(min=1e-12))
    spread = torch.where(polarized, across.sqrt() * (inverse / 2), math.inf).clamp(max=UNIFORM_SPREAD)
    return Uncertainty(
        torch.where(lit, along.sqrt() * scale, math.inf),
        torch.where(lit, spread, UNIFORM_SPREAD),
        torch.where(lit, (d - removed).clamp(min=0), 0.0),
    )
