"""Maps of one exposure set: one for each quantity, their pictures, and the reasons why a pixel has no value."""

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
    """Why a pixel says nothing; of several reasons the last in this list is given."""

    USABLE = 0
    NOISE = 1
    DARK = 2
    SATURATED = 3
    MASKED = 4


REASONS = {
    Reason.USABLE: "usable",
    Reason.NOISE: "noise: the degree of polarization is not above its noise",
    Reason.DARK: "dark: there is no light to be told from the noise",
    Reason.SATURATED: "saturated: a sample that the pixel is made from is at full scale",
    Reason.MASKED: "masked: marked as invalid, or outside of the mask",
}
"""The reasons in words."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one sample of the sensor: variance ``floor + slope * intensity`` (photon transfer, EMVA 1288).

    Attributes:
        floor: variance without light (read-out, quantization), in full scales squared.
        slope: full scales of variance per full scale of intensity: 1 / electrons at full scale.
        source: where it is from: "given" or "estimated".
    """

    floor: float
    slope: float
    source: str


@dataclass(frozen=True, eq=False)
class ShotMaps:
    """The maps of one shot; NumPy arrays at the size of the developed picture.

    DoLP and AoLP of a color picture are those of its luminance, the plain mean of the Stokes vectors of R, G and B;
    angles and degrees are never averaged. The colors themselves are in ``intensities``.

    Attributes:
        name: name of the shot.
        files: it was read from, in the order 0, 45, 90, 135 where there are four.
        intensities: [4, H, W, C] float32, linear, at 0, 45, 90 and 135 degrees, counter-clockwise as displayed; 1 is
            full scale; noise about black may be negative. C is 3 (R, G, B) or 1 (monochrome). Of a set at other angles
            those that the fitted Stokes vectors have.
        stokes: [3, H, W] float32, of the luminance. S0 is 2 where all four intensities are at full scale; a photograph
            shows S0 / 2.
        dolp: [H, W] float32 in [0, 1], as measured.
        dolp_debiased: [H, W] float32 in [0, 1], without what noise adds to it on average.
        aolp: [H, W] float32, radians in [0, pi).
        sigma_dolp: [H, W] float32, standard deviation of ``dolp``; infinite where there is no light.
        sigma_aolp: [H, W] float32, of ``aolp``, radians, at most ``optics.UNIFORM_SPREAD``.
        reason: [H, W] uint8, a ``Reason``. NOISE pixels do have an S0 and a (small) DoLP: means of these over a region
            take them in; they say nothing of an angle or a normal.
        noise: noise of one sample of the sensor.
        pair_ratio: median of (I0 + I90) / (I45 + I135), which is 1 for ideal polarizers; None where it is too dark, and
            of a set at other angles.
        notes: what was assumed, for the user.
        pictures: what the pictures of a set at any angles say of their angles; empty for others.
        residual: [H, W] float32, of a set of more than three pictures: root mean square of what the fit leaves of all
            its samples, in standard deviations of their noise and per degree of freedom. 1 is noise alone; motion,
            clipping and wrong angles are more. None for others.
        left_out: [H, W] uint8, of a set: samples that were not fitted, at full scale or against the others. None for
            others.
        pixel_variance: mean variance of a developed intensity (of the luminance), in variances of a sample.
        mean_variance: that of the mean of many developed intensities, times their number: more, as neighbors share
            samples. None of a set at other angles.
        origin: column and row of the whole picture at which the maps begin.
        whole: width and height of the whole picture, where only a part of it was developed; None: the maps are all.
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
        """Pixels with an angle: no reason against them, [H, W]."""
        return np.asarray(self.reason == Reason.USABLE)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Pixels with a trustworthy S0 and DoLP, [H, W]: usable ones, and those of too small a DoLP for an angle."""
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
"""Pixels between two impulses, more than twice what any interpolation reaches."""


def given_noise(options: ShotOptions, step: float) -> NoiseModel | None:
    """The model of the options, None where they give none. ``step``: one stored value as a share of full scale."""
    if options.full_well is None:
        return None
    read = options.read_noise / options.full_well
    return NoiseModel(read * read + step * step / 12, 1 / options.full_well, "given")


def estimated_noise(intensities: Any, usable: NDArray[np.bool_], step: float) -> NoiseModel:
    """Fit ``floor + slope * intensity`` to how far ``I0 + I90`` is off ``I45 + I135``.

    Four angles measure three unknowns: the difference is zero but for noise, whose variance it has four times (linear
    gradients cancel, too, in a cell of four pixels). Its spread is taken about the median in bins of brightness, so
    that unequal gains do not count, and by the median of absolute differences, so that edges hardly do.

    Args:
        intensities: four arrays [N] (or any one shape), by angle; of cells or of pixels.
        usable: in this shape, neither dark nor saturated.
        step: one stored value as a share of full scale; less noise than it hides is not believed.
    """
    chosen = np.flatnonzero(usable)
    chosen = chosen[:: max(1, len(chosen) // _SAMPLES)]
    least = step * step / 12
    if len(chosen) < _FEWEST:
        return NoiseModel(least, 0.0, "estimated")
    i0, i45, i90, i135 = (np.ravel(i)[chosen].astype(np.float64) for i in intensities)
    mean = (i0 + i45 + i90 + i135) / 4
    excess = i0 + i90 - i45 - i135
    # Whole numbers have no fine quantiles: even noise of one step makes them so, and is taken off again.
    excess += np.random.default_rng(0).uniform(-0.5, 0.5, len(excess)) * step

    def variance(part: NDArray[np.intp]) -> float:
        spread = 1.4826 * float(np.median(np.abs(excess[part] - np.median(excess[part]))))
        return (spread**2 - least) / 4

    return binned_noise(mean, variance, least)


def binned_noise(
    levels: NDArray[np.float64], variance: Callable[[NDArray[np.intp]], float], least: float
) -> NoiseModel:
    """The noise of samples by their variances in bins of brightness.

    Args:
        levels: intensities of the samples, [N]. variance: gives that of some samples, by their places.
        least: variance that is believed at least.
    """
    parts = np.array_split(np.argsort(levels), min(_BINS, max(1, len(levels) // _FEWEST)))
    means = np.array([levels[part].mean() for part in parts])
    variances = np.array([max(variance(part), least) for part in parts])
    return NoiseModel(*noise_line(means, variances, least), "estimated")


def noise_line(x: NDArray[np.float64], y: NDArray[np.float64], least: float) -> tuple[float, float]:
    """Floor and slope, neither negative, of the line through variances; errors of a variance grow with it."""
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
    """Variance of developed intensities, as a multiple of a sample's: of each, and of the mean of many.

    Interpolated values are means of samples and have less noise. The weights of the samples are the responses of the
    demosaicing to an impulse at each position of the pattern. Guided interpolation, which is not linear, is taken to be
    bilinear, and luminance as the mean of the colors.

    Args:
        sensor: name of the sensor. x, y: column and row at which its pattern begins. mode: of demosaicing.

    Returns:
        Factors [4, p, p] over a period p of the pattern. Variance of the mean of many intensities times their number:
        more than the mean of the factors, as interpolated neighbors share samples.
    """
    pattern = sensor_pattern(sensor).shifted(x, y)
    side = 4 * _REACH
    step = DEMOSAIC_MODES[mode]
    period = max(1, pattern.period // step)
    cell = max(pattern.period, step)
    inner = slice(_REACH // step, 2 * _REACH // step)
    summed = np.zeros(len(ANGLES))
    # Half size is the mean over cells of full size, but for S0, of whose noise DoLP and AoLP hardly depend.
    way = "quarter" if mode == "quarter" else "full"
    squares = np.zeros((len(ANGLES), side // step, side // step))
    for row, column in np.ndindex(cell, cell):
        picture = np.zeros((side, side), np.float32)
        picture[row::_REACH, column::_REACH] = 1
        nothing = np.zeros(picture.shape, bool)
        done = demosaic(
            picture, nothing, pattern, mode=way, interpolation="bilinear", colored=False
        ).intensities
        response = done.mean(axis=-1, dtype=np.float64)
        if mode == "half":
            response = response.reshape(len(ANGLES), side // 2, 2, side // 2, 2).mean(axis=(2, 4))
        # Impulses of one position lie so far apart that no pixel sees two.
        squares += response**2
        summed += response[:, inner, inner].sum(axis=(1, 2)) ** 2  # by the only impulse in there
    variances = squares[:, inner, inner]
    blocks = variances.reshape(4, variances.shape[1] // period, period, variances.shape[2] // period, period)
    mean = float(summed.mean()) * step**2 / cell**2
    return np.asarray(blocks.sum(axis=(1, 3)), np.float32), mean


Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Developed:
    """Intensities of a shot before anything is derived from them.

    Attributes:
        intensities: [4, H, W, C] float32, linear; noise about black may be negative.
        dark, saturated, masked: [H, W].
        noise: noise of a sample. factors: variance of an intensity (of the luminance) as a multiple of a sample's,
            [4, p, p] over a period of pixels.
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
"""Column and row at which a part of a picture begins, its width and height."""
