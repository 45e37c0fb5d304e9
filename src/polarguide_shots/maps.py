"""Maps of one exposure set, the reasons against a pixel, and the noise of samples."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.picture_sets import PictureFit
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, demosaic
from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.capture.view import ANGLES
from polarguide_shots.options import ShotOptions

Map = NDArray[np.float32]


class Reason(enum.IntEnum):
    """Reasons why a pixel has no valid angle. A later reason replaces an earlier one."""

    USABLE = 0
    NOISE = 1
    DARK = 2
    SATURATED = 3
    MASKED = 4


REASONS = {
    Reason.USABLE: "usable",
    Reason.NOISE: "noise: the degree of polarization is not above its noise",
    Reason.DARK: "dark: the light is not above the noise",
    Reason.SATURATED: "saturated: a sample of the pixel is at full scale",
    Reason.MASKED: "masked: marked as invalid, or outside of the mask",
}
"""Descriptions of the reasons."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one sample of the sensor: variance ``floor + slope * intensity`` (photon transfer, EMVA 1288).

    Attributes:
        floor: variance without light (read-out, quantization), in full scales squared.
        slope: full scales of variance per full scale of intensity, 1 / electrons at full scale.
        source: "given" by the user or "estimated" from the picture.
    """

    floor: float
    slope: float
    source: str


@dataclass(frozen=True, eq=False)
class ShotMaps:
    """Maps of one shot, NumPy arrays at the size of the developed picture.

    DoLP and AoLP of a color picture refer to its luminance, the plain mean of the Stokes vectors of R, G and B. Angles
    and degrees of polarization are never averaged. The colors are in ``intensities``.

    Attributes:
        name: name of the shot.
        files: files of the shot; four files are in the order 0, 45, 90, 135.
        intensities: [4, H, W, C] float32, linear, at 0, 45, 90 and 135 degrees, counter-clockwise as displayed; 1 is
            full scale. Noise about black may be negative. C is 3 (R, G, B) or 1 (monochrome). For a set at other
            angles, the intensities follow from the fitted Stokes vectors.
        stokes: [3, H, W] float32, of the luminance. S0 is 2 where all four intensities are at full scale; a photograph
            shows S0 / 2.
        dolp: [H, W] float32 in [0, 1], as measured.
        dolp_debiased: [H, W] float32 in [0, 1], without the mean bias by noise.
        aolp: [H, W] float32, radians in [0, pi).
        sigma_dolp: [H, W] float32, standard deviation of ``dolp``; infinite without light.
        sigma_aolp: [H, W] float32, standard deviation of ``aolp``, radians, at most ``optics.UNIFORM_SPREAD``.
        reason: [H, W] uint8, a ``Reason``. NOISE pixels have a valid S0 and a small DoLP, which count in means over a
            region. Their angles and normals are not valid.
        noise: noise of one sample of the sensor.
        pair_ratio: median of (I0 + I90) / (I45 + I135), 1 for ideal polarizers; None for a dark shot or a set.
        notes: assumptions, for the user.
        pictures: comparison of the pictures of a set with one another; empty for other shots.
        residual: [H, W] float32, root mean square residual of the fit of more than three pictures, in standard
            deviations of their noise and per degree of freedom. Noise alone gives 1; motion, clipping and wrong angles
            give more. None for other shots.
        left_out: [H, W] uint8, number of samples of a set that were not fitted because they are clipped or outliers;
            None for other shots.
        pixel_variance: mean variance of a developed intensity (of the luminance), in variances of a sample.
        mean_variance: variance of the mean of many developed intensities, times their number. It exceeds
            ``pixel_variance`` because neighbors share samples. None for a set.
        origin: column and row of the first pixel of the maps in the developed picture.
        whole: width and height of the developed picture if the maps are a part of it, else None.
    """

    name: str
    files: tuple[Path, ...]
    intensities: Map
    stokes: Map
    dolp: Map
    dolp_debiased: Map
    aolp: Map
    sigma_dolp: Map
    sigma_aolp: Map
    reason: NDArray[np.uint8]
    noise: NoiseModel
    pair_ratio: float | None
    notes: tuple[str, ...] = ()
    pictures: tuple[PictureFit, ...] = ()
    residual: Map | None = None
    left_out: NDArray[np.uint8] | None = None
    pixel_variance: float = 1.0
    mean_variance: float | None = None
    origin: tuple[int, int] = (0, 0)
    whole: tuple[int, int] | None = None

    def __repr__(self) -> str:
        shares = (f"{float((self.reason == each).mean()):.1%} {each.name.lower()}" for each in Reason)
        width, height = self.size
        return f"<ShotMaps {self.name}: {width}x{height} pixels\n {', '.join(shares)}; noise {self.noise.source}>"

    @property
    def s0(self) -> Map:
        """S0 of the luminance, [H, W]; a photograph shows half of it."""
        return np.asarray(self.stokes[0])

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Mask of the pixels with a valid angle, [H, W]."""
        return np.asarray(self.reason == Reason.USABLE)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask of the pixels with a valid S0 and DoLP, [H, W]: usable pixels, and pixels with the reason NOISE."""
        return np.asarray(self.reason <= Reason.NOISE)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.reason.shape
        return width, height


_SAMPLES = 400_000
_BINS = 24
_FEWEST = 200
_REACH = 16
"""Pixels between two impulses, more than twice the reach of any interpolation."""


def given_noise(options: ShotOptions, step: float) -> NoiseModel | None:
    """Return the noise that the options state, or None. ``step``: one stored value as a share of full scale."""
    if options.full_well is None:
        return None
    read = options.read_noise / options.full_well
    return NoiseModel(read * read + step * step / 12, 1 / options.full_well, "given")


def estimated_noise(intensities: Any, usable: NDArray[np.bool_], step: float) -> NoiseModel:
    """Fit ``floor + slope * intensity`` to the variance of ``I0 + I90 - I45 - I135``.

    Four angles measure three unknowns. The difference is therefore zero except for noise, and has four times the
    variance of a sample. Linear gradients cancel in a cell of four pixels. The median in each bin of brightness removes
    unequal gains. The median of absolute differences is robust against edges.

    Args:
        intensities: four arrays of one shape, by angle, of cells or of pixels.
        usable: mask in this shape of samples that are not dark or saturated.
        step: one stored value as a share of full scale, which bounds the noise from below.
    """
    chosen = np.flatnonzero(usable)
    chosen = chosen[:: max(1, len(chosen) // _SAMPLES)]
    least = step * step / 12
    if len(chosen) < _FEWEST:
        return NoiseModel(least, 0.0, "estimated")
    i0, i45, i90, i135 = (np.ravel(i)[chosen].astype(np.float64) for i in intensities)
    mean = (i0 + i45 + i90 + i135) / 4
    excess = i0 + i90 - i45 - i135
    # Integers have no fine quantiles. Uniform noise of one step smooths them, and is subtracted below.
    excess += np.random.default_rng(0).uniform(-0.5, 0.5, len(excess)) * step

    def variance(part: NDArray[np.intp]) -> float:
        spread = 1.4826 * float(np.median(np.abs(excess[part] - np.median(excess[part]))))
        return (spread**2 - least) / 4

    return binned_noise(mean, variance, least)


def binned_noise(
    levels: NDArray[np.float64], variance: Callable[[NDArray[np.intp]], float], least: float
) -> NoiseModel:
    """Fit the noise of samples to their variances in bins of brightness.

    Args:
        levels: intensities of the samples, [N].
        variance: function of indices of samples that returns their variance.
        least: lower bound of the variance.
    """
    parts = np.array_split(np.argsort(levels), min(_BINS, max(1, len(levels) // _FEWEST)))
    means = np.array([levels[part].mean() for part in parts])
    variances = np.array([max(variance(part), least) for part in parts])
    return NoiseModel(*noise_line(means, variances, least), "estimated")


def noise_line(x: NDArray[np.float64], y: NDArray[np.float64], least: float) -> tuple[float, float]:
    """Fit a line with nonnegative floor and slope to variances, whose errors are proportional to them."""
    weight = 1 / y
    floor = float(y.mean())
    slope = 0.0
    for _ in range(3):
        (floor, slope), *_ = np.linalg.lstsq(
            np.stack([np.ones_like(x), x], axis=1) * weight[:, None], y * weight, rcond=None
        )
        if slope < 0:
            floor = float((y * weight**2).sum() / (weight**2).sum())
            slope = 0.0
        elif floor < least:
            floor = least
            slope = float((((y - least) * x) * weight**2).sum() / ((x * weight) ** 2).sum())
        weight = 1 / np.maximum(floor + slope * x, least)
    return max(float(floor), least), max(float(slope), 0.0)


@lru_cache(maxsize=8)
def interpolation_factors(sensor: str, x: int, y: int, mode: str) -> tuple[NDArray[np.float32], float]:
    """Compute the variance of developed intensities as a multiple of the variance of a sample.

    Interpolated values are means of samples and have less noise. The weights of the samples are the responses of the
    demosaicing to an impulse at each position of the pattern. Guided interpolation, which is not linear, is treated as
    bilinear. Luminance is the mean of the colors.

    Args:
        sensor: name of the sensor.
        x, y: column and row of the first sample in the sensor.
        mode: mode of demosaicing.

    Returns:
        Factors [4, p, p] over a period p of the pattern, and the variance of the mean of many intensities times their
        number. The latter exceeds the mean of the factors because interpolated neighbors share samples.
    """
    pattern = sensor_pattern(sensor).shifted(x, y)
    side = 4 * _REACH
    step = DEMOSAIC_MODES[mode]
    period = max(1, pattern.period // step)
    cell = max(pattern.period, step)
    inner = slice(_REACH // step, 2 * _REACH // step)
    summed = np.zeros(len(ANGLES))
    # Half size is the mean over cells of full size, except for S0, whose noise hardly affects DoLP and AoLP.
    way = "quarter" if mode == "quarter" else "full"
    squares = np.zeros((len(ANGLES), side // step, side // step))
    for row, column in np.ndindex(cell, cell):
        picture = np.zeros((side, side), np.float32)
        picture[row::_REACH, column::_REACH] = 1
        developed = demosaic(
            picture, np.zeros(picture.shape, bool), pattern, mode=way, interpolation="bilinear", colored=False
        )
        response = developed.intensities.mean(axis=-1, dtype=np.float64)
        if mode == "half":
            response = response.reshape(len(ANGLES), side // 2, 2, side // 2, 2).mean(axis=(2, 4))
        # Impulses of one position are too far apart to overlap.
        squares += response**2
        summed += response[:, inner, inner].sum(axis=(1, 2)) ** 2  # of one impulse
    variances = squares[:, inner, inner]
    blocks = variances.reshape(4, variances.shape[1] // period, period, variances.shape[2] // period, period)
    mean = float(summed.mean()) * step**2 / cell**2
    return np.asarray(blocks.sum(axis=(1, 3)), np.float32), mean


Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Developed:
    """Developed intensities of a shot.

    Attributes:
        intensities: [4, H, W, C] float32, linear; noise about black may be negative.
        dark, saturated, masked: masks [H, W].
        noise: noise of a sample.
        factors: variance of an intensity (of the luminance) as a multiple of the variance of a sample, [4, p, p] over a
            period of pixels.
        mean_variance, pair_ratio, notes, origin, whole: as in ``ShotMaps``.
    """

    intensities: Map
    dark: Mask
    saturated: Mask
    masked: Mask
    noise: NoiseModel
    factors: Map
    mean_variance: float
    pair_ratio: float | None
    notes: tuple[str, ...]
    origin: tuple[int, int] = (0, 0)
    whole: tuple[int, int] | None = None


Part = tuple[int, int, int, int]
"""Column, row, width and height of a part of a picture."""
