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
from polarguide.capture.picture_sets import SetSamples, chosen_pixels, judge, mean_color
from polarguide.geometry.polarizer import four_intensities
from polarguide_shots.maps import NoiseModel, Reason, ShotMaps, given_noise
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
class SetFit:
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

    def fit(self, gray: Array, lost: NDArray[np.bool_]) -> SetFit:
        """Fit pixels [K, N]: least squares, then with the variances that these predict, then without outliers."""
        usable = (~lost & self._used[:, None]).astype(np.float32)
        determined = self._determined(usable)
        usable[:, ~determined] = 1  # something has to be drawn there, too
        stokes, _ = self._solve(usable, gray)
        weights = usable / self.variances(stokes)
        stokes, covariance = self._solve(weights, gray)
        fit = SetFit(stokes, covariance, weights, determined)
        self._drop_outliers(gray, fit)
        return fit

    def _drop_outliers(self, gray: Array, fit: SetFit) -> None:
        """Leave out the sample that is off most, pixel by pixel, while one is off by more than noise is."""
        doubled = self._squares * np.array([[1], [2], [2], [1], [2], [1]], np.float32)
        at = np.flatnonzero(fit.determined)
        while at.size:
            # Of four samples nobody can tell which is wrong: all are equally far off.
            at = at[(fit.weights[:, at] > 0).sum(axis=0) >= 5]
            weights = fit.weights[:, at]
            off = gray[:, at] - self.rows @ fit.stokes[:, at]
            leverage = weights * (doubled.T @ fit.covariance[:, at])
            far = off**2 * weights / np.maximum(1 - leverage, 1e-3)
            worst = far.argmax(axis=0)
            beyond = np.flatnonzero(far[worst, np.arange(at.size)] > self._limit)
            weights = weights[:, beyond]
            weights[worst[beyond], np.arange(beyond.size)] = 0
            determined = self._determined((weights > 0).astype(np.float32))
            weights = weights[:, determined]
            at = at[beyond[determined]]
            fit.weights[:, at] = weights
            fit.stokes[:, at], fit.covariance[:, at] = self._solve(weights, gray[:, at])

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
    """Return the maps of a set of pictures at any angles."""
    chosen = chosen_pixels(samples)
    gray = samples.gray(chosen).astype(np.float64)
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
            "Three pictures leave no residual: the noise is that of neighboring pixels (--full-well states it)."
        )
    size = (height, width)
    maps: dict[str, Any] = {key: np.zeros(size, np.float32) for key in _FLOAT_MAPS}
    maps["intensities"] = np.empty((4, *size, channels), np.float32)
    maps["stokes"] = np.empty((3, *size), np.float32)
    maps["reason"] = np.zeros(size, np.uint8)
    maps["left_out"] = np.zeros(size, np.uint8)
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
"""Maps [H, W] of 32-bit floats."""


def _fill(maps: dict[str, Any], part: slice, samples: SetSamples, model: SetModel, snr: float) -> None:
    """Fit the pixels of some rows: intensities, DoLP and AoLP with uncertainty, and pixels without information."""
    values = samples.intensities(part)
    count, height, width, channels = values.shape
    flat = values.reshape(count, -1, channels)
    gray = mean_color(flat)
    fit = model.fit(gray, samples.lost[:, part].reshape(count, -1))
    colors = [fit.stokes] if channels == 1 else [
        model.project(fit.covariance, fit.weights, np.ascontiguousarray(flat[..., c])) for c in range(channels)
    ]  # fmt: skip
    size = (height, width)
    for channel, of_color in enumerate(colors):
        for place, intensity in enumerate(four_intensities(of_color)):
            maps["intensities"][place, part, :, channel] = intensity.reshape(size)
    stokes = torch.from_numpy(fit.stokes)
    spread = optics.fitted_uncertainty(stokes, torch.from_numpy(fit.covariance))
    degree = optics.dolp(stokes)
    maps["stokes"][:, part] = fit.stokes.reshape(3, *size)
    found = {
        "dolp": degree,
        "aolp": optics.aolp(stokes),
        "sigma_dolp": spread.dolp,
        "sigma_aolp": spread.aolp,
        "dolp_debiased": spread.debiased,
    }
    for key, tensor in found.items():
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
