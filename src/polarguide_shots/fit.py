"""Compute maps from pictures at any polarizer angles, by weighted least squares at each pixel.

The module also estimates the noise, removes outliers, and computes the covariance of the Stokes vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfcinv

from polarguide import optics
from polarguide.capture.exposures import WELL_CONDITIONED
from polarguide.capture.picture_sets import (
    SetLimits,
    SetSamples,
    chosen_pixels,
    judge,
    mean_color,
    typical_variance,
)
from polarguide.geometry.polarizer import four_intensities
from polarguide_shots.maps import NoiseModel, Reason, ShotMaps, binned_noise, given_noise
from polarguide_shots.options import ShotOptions

Floats = NDArray[np.float64]
_REDUNDANT = 0.05
"""Smallest share of a sample's noise that must remain in the residual of a fit, to estimate noise from it."""


def estimated_set_noise(samples: SetSamples, gray: Floats, used: NDArray[np.bool_]) -> NoiseModel:
    """Fit a noise model ``floor + slope * intensity`` to the residuals of the pictures of a set.

    The expected sum of squared residuals of a pixel is the sum of (1 - h) times the variances of its samples, with the
    leverages h. It therefore measures the noise at the mean intensity with these weights. The median in each bin of
    brightness is robust against edges that moved between pictures.

    Args:
        samples: samples of the set.
        gray: luminance [K, N] of the K pictures at N pixels.
        used: mask [K] of the pictures that are fitted.
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
    """Fit a noise model ``floor + slope * intensity`` to differences of neighboring pixels.

    It serves sets with too few pictures for residuals. The difference between a pixel and the mean of its left and
    right neighbor has 3/2 of the variance of a pixel. Texture increases the difference, so the result is an upper bound
    of the noise.
    """
    least = samples.step**2 / 12 / samples.values.shape[-1]
    height, width = samples.dark.shape
    step = max(1, height // max(1, 20 * SetLimits.most_pixels // max(width, 1)))
    bad = samples.lost[:, ::step] | samples.dark[::step] | samples.masked[::step]
    good = ~(bad[..., :-2] | bad[..., 1:-1] | bad[..., 2:])
    pictures = samples.gains.astype(np.float64)[:, None, None] * samples.gray(np.s_[::step])
    level = pictures[..., 1:-1][good]
    differences = (pictures[..., 1:-1] - (pictures[..., :-2] + pictures[..., 2:]) / 2)[good]
    if len(level) < SetLimits.fewest_pixels:
        return NoiseModel(least, 0.0, "estimated")
    return binned_noise(level, lambda part: typical_variance(differences[part] ** 2, 1) / 1.5, least)


FALSE_ALARMS = 1e-3
"""Share of pixels that lose a sample as an outlier although they contain only noise."""
DARK_SNR = 3.0
"""Smallest ratio of S0 to its noise at a pixel that is not dark."""
_TILE = 1 << 14
"""Batch size in pixels. The samples of 36 pictures then fit into the processor's cache."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Row and column of each stored entry of a symmetric matrix, in the order of ``optics.fitted_uncertainty``."""
Array = NDArray[np.float32]


@dataclass(eq=False)
class SetFit:
    """Result of fitting Stokes vectors to N pixels of K pictures.

    Attributes:
        stokes: [3, N] Stokes vectors of the luminance.
        covariance: [6, N] covariances of the Stokes vectors, in the order of ``_PAIRS``.
        weights: [K, N] weights of the samples, 0 for samples that are left out.
        determined: mask [N] of pixels whose samples determine a Stokes vector.
    """

    stokes: Array
    covariance: Array
    weights: Array
    determined: NDArray[np.bool_]


class SetModel:
    """Model of the intensities of a set: Malus's law at the angles of its pictures, and the noise.

    Args:
        samples: samples of the set.
        used: mask [K] of the pictures that are fitted.
        noise: noise of a sample.
        share: ratio of the variance of a luminance to the variance of a sample.
    """

    def __init__(self, samples: SetSamples, used: NDArray[np.bool_], noise: NoiseModel, share: float) -> None:
        self.rows = samples.rows
        self._used = used
        self._squares = np.stack([self.rows[:, i] * self.rows[:, j] for i, j in _PAIRS])
        gains = samples.gains[:, None]
        self._floor = np.float32(noise.floor * share) / gains**2
        self._slope = np.float32(noise.slope * share) / gains
        self._limit = 2 * float(erfcinv(FALSE_ALARMS / len(used))) ** 2  # squared limit, two-sided test

    def variances(self, stokes: Array) -> Array:
        """Predict the variances [K, N] of the samples from Stokes vectors [3, N]."""
        return np.asarray(self._floor + self._slope * np.maximum(self.rows @ stokes, 0), np.float32)

    def fit(self, gray: Array, lost: NDArray[np.bool_]) -> SetFit:
        """Fit Stokes vectors by least squares, repeat the fit with predicted variances, and remove outliers.

        Args:
            gray: luminance [K, N].
            lost: mask [K, N] of clipped samples.
        """
        usable = (~lost & self._used[:, None]).astype(np.float32)
        determined = self._determined(usable)
        usable[:, ~determined] = 1  # such pixels also get a value, for the pictures of the maps
        stokes, _ = self._solve(usable, gray)
        weights = usable / self.variances(stokes)
        fit = SetFit(*self._solve(weights, gray), weights, determined)
        self._drop_outliers(gray, fit)
        return fit

    def _drop_outliers(self, gray: Array, fit: SetFit) -> None:
        """Remove the sample with the largest residual of each pixel, until all residuals agree with the noise."""
        doubled = self._squares * np.array([[1], [2], [2], [1], [2], [1]], np.float32)
        at = np.flatnonzero(fit.determined)
        while at.size:
            # With four samples, all residuals are equal and do not identify an outlier.
            at = at[(fit.weights[:, at] > 0).sum(axis=0) >= 5]
            weights = fit.weights[:, at]
            leverage = weights * (doubled.T @ fit.covariance[:, at])
            squares = (gray[:, at] - self.rows @ fit.stokes[:, at]) ** 2
            residuals = squares * weights / np.maximum(1 - leverage, 1e-3)
            worst = residuals.argmax(axis=0)
            outliers = np.flatnonzero(residuals[worst, np.arange(at.size)] > self._limit)
            weights = weights[:, outliers]
            weights[worst[outliers], np.arange(outliers.size)] = 0
            determined = self._determined((weights > 0).astype(np.float32))
            weights = weights[:, determined]
            at = at[outliers[determined]]
            fit.weights[:, at] = weights
            fit.stokes[:, at], fit.covariance[:, at] = self._solve(weights, gray[:, at])

    def _determined(self, usable: Array) -> NDArray[np.bool_]:
        """Return a mask [N] of pixels whose usable samples determine a Stokes vector well.

        ``usable`` is [K, N], 1 for a usable sample and 0 otherwise.
        """
        determined = np.ones(usable.shape[1], bool)
        some = np.flatnonzero(usable.sum(axis=0) < self._used.sum())
        if some.size:
            sums = self._squares @ usable[:, some]
            matrices = np.empty((some.size, 3, 3))
            for (i, j), values in zip(_PAIRS, sums, strict=True):
                matrices[:, i, j] = matrices[:, j, i] = values
            spectrum = np.linalg.eigvalsh(matrices)
            determined[some] = spectrum[:, 0] > WELL_CONDITIONED**2 * spectrum[:, -1]
        return determined

    def _solve(self, weights: Array, values: Array) -> tuple[Array, Array]:
        """Solve weighted least squares at each pixel for values [K, N].

        Returns:
            Stokes vectors [3, N]; and inverse normal matrices [6, N].
        """
        a, b, c, d, e, f = (self._squares @ weights).astype(np.float64)
        # Cofactors of the symmetric matrix ((a, b, c), (b, d, e), (c, e, f)).
        inverse = np.stack(
            (d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b)
        )
        inverse /= a * inverse[0] + b * inverse[1] + c * inverse[2]
        return self.project(inverse, weights, values), inverse.astype(np.float32)

    def project(self, inverse: NDArray[Any], weights: Array, values: Array) -> Array:
        """Return the Stokes vectors [3, N] of values [K, N], given the inverse normal matrices."""
        x, y, z = (self.rows.T @ (weights * values)).astype(np.float64)
        p, q, r, s, t, u = inverse
        stokes = np.stack((p * x + q * y + r * z, q * x + s * y + t * z, r * x + t * y + u * z))
        return stokes.astype(np.float32)

    def residual(self, gray: Array, stokes: Array) -> Array:
        """Return the root mean square residual [N] of all samples of a pixel.

        Its unit is the standard deviation of the noise, per degree of freedom.
        """
        squares = (gray - self.rows @ stokes) ** 2 / self.variances(stokes)
        return np.sqrt(squares.sum(axis=0) / (len(gray) - 3))


def maps_of_set(name: str, files: tuple[Path, ...], samples: SetSamples, options: ShotOptions) -> ShotMaps:
    """Compute the maps of a set of pictures at any angles.

    Args:
        name: name of the shot.
        files: files of the shot.
        samples: the pictures.
        options: options of the shot.
    """
    gray = samples.gray(chosen_pixels(samples)).astype(np.float64)
    judgment = judge(samples, gray)
    notes = [*samples.notes, *judgment.notes]
    noise = given_noise(options, samples.step)
    count, height, width, channels = samples.values.shape
    share = 1.0 if noise is None else 1 / channels
    if noise is None and judgment.used.sum() > 3:
        noise = estimated_set_noise(samples, gray, judgment.used)
    elif noise is None:
        noise = neighbor_noise(samples)
        notes.append(
            "Three pictures have no residuals. The noise is estimated from neighboring pixels; --full-well states it."
        )
    size = (height, width)
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(_FLOAT_MAPS, size),
        "intensities": (4, *size, channels),
        "stokes": (3, *size),
    }
    maps: dict[str, Any] = {key: np.zeros(shape, np.float32) for key, shape in shapes.items()}
    maps |= {key: np.zeros(size, np.uint8) for key in ("reason", "left_out")}
    model = SetModel(samples, judgment.used, noise, share)
    rows = max(1, _TILE // width)
    for top in range(0, height, rows):
        _fill(maps, slice(top, min(top + rows, height)), samples, model, options.snr)
    residual = maps.pop("residual")
    return ShotMaps(
        name=name,
        files=files,
        noise=noise,
        pair_ratio=None,
        notes=tuple(notes),
        pictures=judgment.pictures,
        residual=residual if count > 3 else None,
        **maps,
    )


_FLOAT_MAPS = ("dolp", "dolp_debiased", "aolp", "sigma_dolp", "sigma_aolp", "residual")
"""Names of the maps that are stored as 32-bit floats."""


def _fill(maps: dict[str, Any], part: slice, samples: SetSamples, model: SetModel, snr: float) -> None:
    """Fit the pixels of some rows, and store their values in the maps.

    Args:
        maps: maps by name, which are modified.
        part: the rows.
        samples: samples of the set.
        model: angles and noise of the pictures.
        snr: smallest ratio of the DoLP to its standard deviation at a pixel with a valid angle.
    """
    values = samples.intensities(part)
    count, height, width, channels = values.shape
    flat = values.reshape(count, -1, channels)
    gray = mean_color(flat)
    fit = model.fit(gray, samples.lost[:, part].reshape(count, -1))
    colors = [fit.stokes] if channels == 1 else [
        model.project(fit.covariance, fit.weights, np.ascontiguousarray(flat[..., c])) for c in range(channels)
    ]  # fmt: skip
    size = (height, width)
    for channel, color in enumerate(colors):
        for place, intensity in enumerate(four_intensities(color)):
            maps["intensities"][place, part, :, channel] = intensity.reshape(size)
    stokes = torch.from_numpy(fit.stokes)
    spread = optics.fitted_uncertainty(stokes, torch.from_numpy(fit.covariance))
    degree = optics.dolp(stokes)
    maps["stokes"][:, part] = fit.stokes.reshape(3, *size)
    for key, tensor in zip(
        _FLOAT_MAPS, (degree, spread.debiased, optics.aolp(stokes), spread.dolp, spread.aolp), strict=False
    ):
        maps[key][part] = tensor.reshape(size).numpy()
    if count > 3:
        maps["residual"][part] = model.residual(gray, fit.stokes).reshape(size)
    maps["left_out"][part] = np.minimum((fit.weights == 0).sum(axis=0), 255).reshape(size)
    reason = maps["reason"][part].reshape(-1)
    for mask, kind in (
        ((degree <= snr * spread.dolp).numpy(), Reason.NOISE),
        (fit.stokes[0] <= DARK_SNR * np.sqrt(fit.covariance[0]), Reason.DARK),
        (samples.dark[part].reshape(-1), Reason.DARK),
        (~fit.determined, Reason.SATURATED),
        (samples.masked[part].reshape(-1), Reason.MASKED),
    ):
        reason[mask] = kind
