"""Measure one view: exposure, noise, consistency of the four angles, polarization."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from polarguide import optics
from polarguide.capture.exposures import FOUR
from polarguide.inspection.capture import InspectedView

MEASURABLE = 1.0 / 256.0
"""Mean intensity from which on a pixel is bright enough for its polarization to be measured: a step of 8 bits."""
POLARIZED = 0.05
"""DoLP from which a pixel counts as polarized."""
OF_FOUR = ("noise", "noise_share", "pair_ratio", "sum_error", "dolp", "polarized", "above_limit")
"""What only four angles of a view tell."""
_QUANTILE_SAMPLES = 200_000


@dataclass(frozen=True)
class ViewMeasurements:
    """Measurements of one view. ``saturated``, ``invalid`` and ``dark`` are shares of all pixels, others of the usable.

    Attributes:
        view: its name.
        bright: 99th percentile of the intensities, in [0, 1].
        saturated, invalid, dark: shares of pixels with an angle at full scale, marked invalid by the capture though
            they are not dark, and darker than 1/256.
        noise: median standard deviation of the noise of one intensity (mean over the colors), after averaging down.
        noise_share: the same, as a share of S0 / 2.
        pair_ratio: median of (I0 + I90) / (I45 + I135); None where too few pixels are bright enough.
        sum_error: median of |I0 + I90 - I45 - I135| / S0.
        dolp: quantiles 0.5 and 0.99 of the DoLP.
        polarized: share with a DoLP over 0.05 and over three times its noise.
        above_limit: share with a DoLP over the limit of diffuse light by three times its noise.
        exposures: the angles of its pictures where they are not 0, 45, 90 and 135 degrees; then noise and all that
            follows from four angles is not measured.
    """

    view: str
    bright: float
    saturated: float
    invalid: float
    dark: float
    noise: float = 0.0
    noise_share: float = 0.0
    pair_ratio: float | None = None
    sum_error: float = 0.0
    dolp: tuple[float, float] = (0.0, 0.0)
    polarized: float = 0.0
    above_limit: float = 0.0
    exposures: str = ""

    def record(self) -> dict[str, Any]:
        """As plain JSON types."""
        measured = {**vars(self), "dolp": {"median": self.dolp[0], "p99": self.dolp[1]}}
        if self.exposures:
            return {key: None if key in OF_FOUR else value for key, value in measured.items()}
        return measured


def measure_view(view: InspectedView, index: float) -> ViewMeasurements:
    """Measure one view.

    Args:
        view: its pictures.
        index: refractive index.
    """
    gray = view.intensities().mean(dim=-1)
    dark = gray.mean(dim=0) < MEASURABLE
    good = view.usable & ~dark
    share = float(good.float().mean())
    bright = quantile(view.intensities().amax(dim=-1).flatten(), 0.99)
    # Black is no fault: prepare marks it invalid, because nothing can be read from it.
    lost = (view.saturated & ~view.black, view.invalid & ~dark, dark)
    saturated, invalid, black = (float(mask.float().mean()) for mask in lost)
    nothing = ViewMeasurements(view.name, bright, saturated, invalid, black)
    if view.exposures != FOUR:
        return replace(nothing, exposures=", ".join(exposure.words for exposure in view.exposures))
    if share < 0.001:
        return nothing
    stokes, noise = optics.stokes(gray), optics.intensity_noise(gray)
    i0, i45, i90, i135 = (angle[good] for angle in gray)
    s0 = stokes[0][good]
    degree, spread = optics.dolp(stokes)[good], optics.dolp_noise(stokes, noise)[good]
    limit = float(optics.diffuse_dolp_limit(index))
    return replace(
        nothing,
        noise=quantile(noise[good], 0.5),
        noise_share=quantile(noise[good] / (s0 / 2), 0.5),
        pair_ratio=quantile((i0 + i90) / (i45 + i135).clamp(min=1e-6), 0.5),
        sum_error=quantile((i0 + i90 - i45 - i135).abs() / s0, 0.5),
        dolp=(quantile(degree, 0.5), quantile(degree, 0.99)),
        polarized=float(((degree > POLARIZED) & (degree > 3 * spread)).float().mean()),
        above_limit=float((degree > limit + 3 * spread).float().mean()),
    )


def quantile(values: Tensor, q: float) -> float:
    """Quantile of the values; of a regular subset where there are very many."""
    step = max(1, values.numel() // _QUANTILE_SAMPLES)
    # NumPy selects where torch sorts, which takes many times as long.
    return float(np.quantile(values.flatten()[::step].numpy(), q))
