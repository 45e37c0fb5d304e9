"""Noise of a set of pictures: from what its fit leaves, or from neighboring pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.picture_sets import SetLimits, SetSamples, typical_variance
from polarguide_shots.maps import NoiseModel, binned_noise

Floats = NDArray[np.float64]
_REDUNDANT = 0.05
"""Smallest share of a sample's noise in the residual of a fit from which noise is estimated."""


def estimated_set_noise(samples: SetSamples, gray: Floats, used: NDArray[np.bool_]) -> NoiseModel:
    """Fit ``floor + slope * intensity`` to what least squares leaves of the pictures of a set.

    The expected sum of squared residuals of a pixel is the sum of (1 - h) times the variances of its samples, h being
    their leverages; so it tells the noise at the mean intensity with these weights. Its median in bins of brightness
    counts, so that moved edges hardly do.

    Args:
        samples: the set. gray: [K, N], its luminance at some pixels. used: [K], the pictures that are fitted.
    """
    least = samples.step**2 / 12 / samples.values.shape[-1]
    rows = samples.rows[used].astype(np.float64)
    hat = rows @ np.linalg.pinv(rows)
    free = 1 - np.diag(hat)
    freedom = int(used.sum()) - 3
    if freedom < 1 or gray.shape[1] < SetLimits.fewest_pixels or free.max() < _REDUNDANT:
        return NoiseModel(least, 0.0, "estimated")
    gains = samples.gains[used].astype(np.float64)
    fitted = hat @ gray[used]
    squares = ((gray[used] - fitted) ** 2).sum(axis=0)
    flat = float((free / gains**2).sum())
    level = (free / gains) @ np.maximum(fitted, 0) / flat
    return binned_noise(level, lambda part: typical_variance(squares[part], freedom) * freedom / flat, least)


def neighbor_noise(samples: SetSamples) -> NoiseModel:
    """Fit ``floor + slope * intensity`` to differences of neighboring pixels, for sets that leave no residual.

    A pixel less the mean of those left and right of it has 3/2 of its variance; texture adds to it, so that the noise
    is stated rather too large.
    """
    least = samples.step**2 / 12 / samples.values.shape[-1]
    height, width = samples.dark.shape
    step = max(1, height // max(1, 20 * SetLimits.most_pixels // max(width, 1)))
    bad = samples.lost[:, ::step] | samples.dark[::step] | samples.masked[::step]
    good = ~(bad[..., :-2] | bad[..., 1:-1] | bad[..., 2:])
    pictures = samples.gains.astype(np.float64)[:, None, None] * samples.gray(np.s_[::step])
    level = pictures[..., 1:-1][good]
    apart = (pictures[..., 1:-1] - (pictures[..., :-2] + pictures[..., 2:]) / 2)[good]
    if len(level) < SetLimits.fewest_pixels:
        return NoiseModel(least, 0.0, "estimated")
    return binned_noise(level, lambda part: typical_variance(apart[part] ** 2, 1) / 1.5, least)
