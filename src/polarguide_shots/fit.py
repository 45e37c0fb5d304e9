"""Weighted least squares of a set at any angles, pixel by pixel: Stokes vectors, their covariance, and outliers."""

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
from polarguide.capture.picture_sets import SetSamples, chosen_pixels, judge, luminance
from polarguide.geometry.polarizer import four_intensities
from polarguide_shots.maps import Map, NoiseModel, Reason, ShotMaps, given_noise
from polarguide_shots.options import ShotOptions
from polarguide_shots.set_noise import estimated_set_noise, neighbor_noise

FALSE_ALARMS = 1e-3
"""Share of pixels of pure noise that lose a sample as an outlier."""
DARK_SNR = 3.0
"""S0 in units of its noise from which on there is light."""
_TILE = 1 << 14
"""Pixels that are fitted at a time, so that 36 pictures of them stay in the processor's cache."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Places in a symmetric matrix, in the order of ``optics.fitted_uncertainty``."""
Array = NDArray[np.float32]


@dataclass(eq=False)
class PixelFit:
    """The fit of some pixels.

    Attributes:
        stokes: [3, N] of the luminance. covariance: [6, N].
        weights: [K, N], 0 for samples that are left out. determined: [N].
    """

    stokes: Array
    covariance: Array
    weights: Array
    determined: NDArray[np.bool_]


class SetModel:
    """Malus's law at the angles of a set, with the noise of its samples."""

    def __init__(self, samples: SetSamples, used: NDArray[np.bool_], noise: NoiseModel, share: float) -> None:
        """Take the pictures that are ``used``; ``share``: variance of a luminance over that of a sample."""
        self.rows = samples.rows
        self._used = used
        self._squares = np.stack([self.rows[:, i] * self.rows[:, j] for i, j in _PAIRS])
        gains = samples.gains[:, None]
        self._floor = np.float32(noise.floor * share) / gains**2
        self._slope = np.float32(noise.slope * share) / gains
        self._limit = 2 * float(erfcinv(FALSE_ALARMS / len(used))) ** 2  # the square of it, two-sided

    def variances(self, stokes: Array) -> Array:
        """Variances [K, N] of the samples of Stokes vectors [3, N]."""
        return np.asarray(self._floor + self._slope * np.maximum(self.rows @ stokes, 0), np.float32)

    def fit(self, gray: Array, lost: NDArray[np.bool_]) -> PixelFit:
        """Fit pixels [K, N]: least squares, then with the variances that these predict, then without outliers."""
        usable = (~lost & self._used[:, None]).astype(np.float32)
        determined = self._determined(usable)
        usable[:, ~determined] = 1  # something has to be drawn there, too
        stokes, _ = self._solve(usable, gray)
        weights = usable / self.variances(stokes)
        stokes, covariance = self._solve(weights, gray)
        fit = PixelFit(stokes, covariance, weights, determined)
        self._drop_outliers(gray, fit)
        return fit

    def _drop_outliers(self, gray: Array, fit: PixelFit) -> None:
        """Leave out the sample that is off most, pixel by pixel, while one is off by more than noise is."""
        at = np.flatnonzero(fit.determined)
        while at.size:
            weights = fit.weights[:, at]
            picked = gray[:, at]
            # Of four samples nobody can tell which is wrong: all are equally far off.
            testable = (weights > 0).sum(axis=0) >= 5
            at = at[testable]
            weights = weights[:, testable]
            picked = picked[:, testable]
            if not at.size:
                return
            off = picked - self.rows @ fit.stokes[:, at]
            doubled = self._squares.copy()
            doubled[[1, 2, 4]] *= 2
            leverage = weights * (doubled.T @ fit.covariance[:, at])
            far = off**2 * weights / np.maximum(1 - leverage, 1e-3)
            worst = far.argmax(axis=0)
            beyond = np.flatnonzero(far[worst, np.arange(at.size)] > self._limit)
            weights = weights[:, beyond]
            weights[worst[beyond], np.arange(beyond.size)] = 0
            determined = self._determined((weights > 0).astype(np.float32))
            weights = weights[:, determined]
            beyond = beyond[determined]
            at = at[beyond]
            picked = picked[:, beyond]
            if at.size:
                fit.weights[:, at] = weights
                fit.stokes[:, at], fit.covariance[:, at] = self._solve(weights, picked)

    def _determined(self, usable: Array) -> NDArray[np.bool_]:
        """Whether the samples that are used, [K, N] of 0 and 1, determine a Stokes vector well, [N]."""
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
        """Weighted least squares of [K, N]: Stokes vectors [3, N], and the inverse [6, N] of the normal matrix."""
        a, b, c, d, e, f = (self._squares @ weights).astype(np.float64)
        # Cofactors of the symmetric matrix ((a, b, c), (b, d, e), (c, e, f)).
        inverse = np.stack(
            (d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b)
        )
        inverse /= a * inverse[0] + b * inverse[1] + c * inverse[2]
        return self.project(inverse, weights, values), inverse.astype(np.float32)

    def project(self, inverse: NDArray[Any], weights: Array, values: Array) -> Array:
        """The Stokes vectors [3, N] of samples [K, N], with the inverse of the normal matrix."""
        x, y, z = (self.rows.T @ (weights * values)).astype(np.float64)
        p, q, r, s, t, u = inverse
        return np.stack((p * x + q * y + r * z, q * x + s * y + t * z, r * x + t * y + u * z)).astype(
            np.float32
        )

    def residual(self, gray: Array, stokes: Array) -> Array:
        """Root mean square of what is left of all samples, [N]: in standard deviations, per degree of freedom."""
        off = (gray - self.rows @ stokes) ** 2 / self.variances(stokes)
        return np.sqrt(off.sum(axis=0) / (len(gray) - 3))


def maps_of_set(name: str, files: tuple[Path, ...], samples: SetSamples, options: ShotOptions) -> ShotMaps:
    """The maps of a set of pictures at any angles."""
    chosen = chosen_pixels(samples)
    gray = samples.gray(chosen).astype(np.float64)
    judgment = judge(samples, gray)
    notes = [*samples.notes, *judgment.notes]
    noise = given_noise(options, samples.step)
    channels = samples.values.shape[-1]
    share = 1.0 if noise is None else 1 / channels
    if noise is None and judgment.used.sum() > 3:
        noise = estimated_set_noise(samples, gray, judgment.used)
    elif noise is None:
        noise = neighbor_noise(samples)
        notes.append(
            "Three pictures leave no residual: the noise is that of neighboring pixels (--full-well states it)."
        )
    model = SetModel(samples, judgment.used, noise, share)
    arrays = _Arrays(samples)
    for top in range(0, arrays.height, arrays.rows):
        arrays.fill(slice(top, min(top + arrays.rows, arrays.height)), samples, model, options.snr)
    for mask, kind in (
        (samples.dark, Reason.DARK),
        (~arrays.determined, Reason.SATURATED),
        (samples.masked, Reason.MASKED),
    ):
        arrays.reason[mask] = kind
    return ShotMaps(
        name=name,
        files=files,
        intensities=arrays.intensities,
        stokes=arrays.stokes,
        dolp=arrays.dolp,
        dolp_debiased=arrays.debiased,
        aolp=arrays.aolp,
        sigma_dolp=arrays.sigma_dolp,
        sigma_aolp=arrays.sigma_aolp,
        reason=arrays.reason,
        noise=noise,
        pair_ratio=None,
        notes=tuple(notes),
        pictures=judgment.pictures,
        residual=arrays.residual if len(samples.labels) > 3 else None,
        left_out=arrays.left_out,
    )


class _Arrays:
    """The maps while they are filled, some rows at a time."""

    def __init__(self, samples: SetSamples) -> None:
        self.height, width, channels = samples.values.shape[1:]
        size = (self.height, width)
        self.rows = max(1, _TILE // width)
        self.intensities: Map = np.empty((4, *size, channels), np.float32)
        self.stokes: Map = np.empty((3, *size), np.float32)
        self.dolp, self.debiased, self.aolp, self.sigma_dolp, self.sigma_aolp, self.residual = (
            np.zeros(size, np.float32) for _ in range(6)
        )
        self.reason = np.zeros(size, np.uint8)
        self.left_out = np.zeros(size, np.uint8)
        self.determined = np.ones(size, bool)

    def fill(self, part: slice, samples: SetSamples, model: SetModel, snr: float) -> None:
        """Fit the pixels of some rows."""
        values = samples.intensities(part)
        count, height, width, channels = values.shape
        flat = values.reshape(count, -1, channels)
        gray = luminance(flat)
        fit = model.fit(gray, samples.lost[:, part].reshape(count, -1))
        colors = [fit.stokes] if channels == 1 else [
            model.project(fit.covariance, fit.weights, np.ascontiguousarray(flat[..., c])) for c in range(channels)
        ]  # fmt: skip
        size = (height, width)
        for channel, stokes in enumerate(colors):
            for place, values in enumerate(four_intensities(stokes)):
                self.intensities[place, part, :, channel] = values.reshape(size)
        self._state(part, fit, size, snr)
        self.determined[part] = fit.determined.reshape(size)
        self.left_out[part] = np.minimum((fit.weights == 0).sum(axis=0), 255).reshape(size)
        if count > 3:
            self.residual[part] = model.residual(gray, fit.stokes).reshape(size)

    def _state(self, part: slice, fit: PixelFit, size: tuple[int, int], snr: float) -> None:
        """DoLP, AoLP and their uncertainty, and which pixels say nothing."""
        stokes = torch.from_numpy(fit.stokes)
        spread = optics.fitted_uncertainty(stokes, torch.from_numpy(fit.covariance))
        degree = optics.dolp(stokes)
        self.stokes[:, part] = fit.stokes.reshape(3, *size)
        self.dolp[part] = degree.reshape(size).numpy()
        self.aolp[part] = optics.aolp(stokes).reshape(size).numpy()
        self.sigma_dolp[part] = spread.dolp.reshape(size).numpy()
        self.sigma_aolp[part] = spread.aolp.reshape(size).numpy()
        self.debiased[part] = spread.debiased.reshape(size).numpy()
        why = np.zeros(degree.shape, np.uint8)
        why[(degree <= snr * spread.dolp).numpy()] = Reason.NOISE
        why[fit.stokes[0] <= DARK_SNR * np.sqrt(fit.covariance[0])] = Reason.DARK
        self.reason[part] = why.reshape(size)
