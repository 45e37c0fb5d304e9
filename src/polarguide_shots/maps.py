"""Polarization maps of a shot, the reasons to reject pixels, and the noise of samples."""

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
    """Reason why a pixel has no valid angle. If several reasons apply, the one with the largest number is stored."""

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
"""Description of each reason for users."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one sample of the sensor: its variance is ``floor + slope * intensity`` (photon transfer, EMVA 1288).

    Attributes:
        floor: variance without light, in full scales squared. It contains read noise and quantization.
        slope: increase of the variance with the intensity, both in full scales. It is 1 / electrons at full scale.
        source: "given" if the user specified the noise, "estimated" if it is estimated from the picture.
    """

    floor: float
    slope: float
    source: str


@dataclass(frozen=True, eq=False)
class ShotMaps:
    """Polarization maps of one shot, as NumPy arrays at the size of the developed picture.

    DoLP and AoLP of a color picture refer to its luminance, the plain mean of the Stokes vectors of R, G and B. Angles
    and degrees of polarization are never averaged. The colors are in ``intensities``.

    Attributes:
        name: name of the shot.
        files: files of the shot. Four files are in the order 0, 45, 90, 135.
        intensities: [4, H, W, C] float32, linear, at 0, 45, 90 and 135 degrees counter-clockwise as displayed. 1 is
            full scale. Noise around black may be negative. C is 3 (R, G, B) or 1 (monochrome). For a set at other
            angles, the intensities are computed from the fitted Stokes vectors.
        stokes: [3, H, W] float32, Stokes vectors of the luminance. S0 is 2 where all four intensities are at full
            scale. A photograph shows S0 / 2.
        dolp: [H, W] float32 in [0, 1], as measured.
        dolp_debiased: [H, W] float32 in [0, 1], without the mean bias by noise.
        aolp: [H, W] float32, radians in [0, pi).
        sigma_dolp: [H, W] float32, standard deviation of ``dolp``. It is infinite without light.
        sigma_aolp: [H, W] float32, standard deviation of ``aolp``, radians. Its maximum is ``optics.UNIFORM_SPREAD``.
        reason: [H, W] uint8, a ``Reason``. Pixels with the reason NOISE have a valid S0 and a small DoLP, which count
            in means over a region. Their angles and normals are not valid.
        noise: noise of one sample of the sensor.
        pair_ratio: median of (I0 + I90) / (I45 + I135), which is 1 for ideal polarizers. None for a dark shot or a set.
        notes: sentences for the user about assumptions.
        pictures: comparison of the pictures of a set with one another. Empty for other shots.
        residual: [H, W] float32, root mean square residual of a fit to more than three pictures. The unit is the
            standard deviation of the noise, per degree of freedom: noise alone gives 1, while motion, clipping and
            wrong angles give more. None for other shots.
        left_out: [H, W] uint8, number of samples of a set that were left out of the fit because they are clipped or
            outliers. None for other shots.
        pixel_variance: ratio of the mean variance of a developed intensity (of the luminance) to the variance of a
            sample.
        mean_variance: variance of the mean of many developed intensities, multiplied by their number. It exceeds
            ``pixel_variance`` because neighboring pixels share samples. None for a set.
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
        """S0 of the luminance, [H, W]. A photograph without a polarizer shows half of it."""
        return np.asarray(self.stokes[0])

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Mask of the pixels with a valid angle, [H, W]."""
        return np.asarray(self.reason == Reason.USABLE)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask [H, W] of the pixels with a valid S0 and DoLP: usable pixels, and pixels with the reason NOISE."""
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
"""Distance in pixels between two test impulses. It exceeds twice the reach of any interpolation."""


def given_noise(options: ShotOptions, step: float) -> NoiseModel | None:
    """Return the noise that the user specified in the options, or None if the options contain no noise.

    Args:
        options: options of the shot.
        step: difference between two successive stored values, as a share of full scale.
    """
    if options.full_well is None:
        return None
    read = options.read_noise / options.full_well
    return NoiseModel(read * read + step * step / 12, 1 / options.full_well, "given")


def estimated_noise(intensities: Any, usable: NDArray[np.bool_], step: float) -> NoiseModel:
    """Fit a noise model ``floor + slope * intensity`` to the variance of ``I0 + I90 - I45 - I135``.

    Four angles measure three unknowns. The difference is therefore zero except for noise, and has four times the
    variance of a sample. Linear gradients cancel in a cell of four pixels. The median in each bin of brightness removes
    unequal gains. The median of absolute differences is robust against edges.

    Args:
        intensities: four arrays of the same shape, one for each angle, of cells or of pixels.
        usable: mask in this shape of samples that are not dark or saturated.
        step: difference between two successive stored values, as a share of full scale. It gives a lower bound of the
            noise.
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
    """Fit a noise model to the variances of samples in bins of brightness.

    Args:
        levels: intensities of the samples, [N].
        variance: function that returns the variance of the samples with the given indices.
        least: lower bound of the variance.
    """
    parts = np.array_split(np.argsort(levels), min(_BINS, max(1, len(levels) // _FEWEST)))
    means = np.array([levels[part].mean() for part in parts])
    variances = np.array([max(variance(part), least) for part in parts])
    return NoiseModel(*noise_line(means, variances, least), "estimated")


def noise_line(x: NDArray[np.float64], y: NDArray[np.float64], least: float) -> tuple[float, float]:
    """Fit a line to variances. Floor and slope are not negative, and errors are proportional to the variances."""
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
    """Compute how much noise demosaicing leaves in the developed intensities.

    Interpolated values are means of samples and have less noise. The weights of the samples are the responses of the
    demosaicing to an impulse at each position of the pattern. Luminance is the mean of the colors.

    Args:
        sensor: name of the sensor.
        x: column of the first sample in the sensor.
        y: row of the first sample in the sensor.
        mode: mode of demosaicing.

    Returns:
        Two results. The first contains factors [4, p, p] over a period p of the pattern. A factor is the variance of an
        intensity, divided by the variance of a sample. The second is the variance of the mean of many intensities,
        multiplied by their number. It exceeds the mean of the factors because neighboring pixels share samples.
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
        developed = demosaic(picture, np.zeros(picture.shape, bool), pattern, mode=way, colored=False)
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
    """Developed intensities of a shot, from which the maps are computed.

    Attributes:
        intensities: [4, H, W, C] float32, linear. Noise around black may be negative.
        dark: mask [H, W] of dark pixels.
        saturated: mask [H, W] of saturated pixels.
        masked: mask [H, W] of pixels that are masked out.
        noise: noise of a sample.
        factors: [4, p, p] variance of an intensity (of the luminance), divided by the variance of a sample, over a
            period of p pixels.
        mean_variance: as in ``ShotMaps``.
        pair_ratio: as in ``ShotMaps``.
        notes: as in ``ShotMaps``.
        origin: as in ``ShotMaps``.
        whole: as in ``ShotMaps``.
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
"""Type of a part of a picture, as column, row, width and height."""
