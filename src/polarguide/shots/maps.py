"""What is measured in one exposure set: a map per quantity, and per pixel why it says nothing."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
        name: of the shot.
        files: it was read from, in the order 0, 45, 90, 135 where there are four.
        intensities: [4, H, W, C] float32, linear, at 0, 45, 90 and 135 degrees, counter-clockwise as displayed; 1 is
            full scale; noise about black may be negative. C is 3 (R, G, B) or 1 (monochrome).
        stokes: [3, H, W] float32, of the luminance. S0 is 2 where all four intensities are at full scale; a photograph
            shows S0 / 2.
        dolp: [H, W] float32 in [0, 1], as measured.
        dolp_debiased: [H, W] float32 in [0, 1], without what noise adds to it on average.
        aolp: [H, W] float32, radians in [0, pi).
        sigma_dolp: [H, W] float32, standard deviation of ``dolp``; infinite where there is no light.
        sigma_aolp: [H, W] float32, of ``aolp``, radians, at most ``optics.UNIFORM_SPREAD``.
        reason: [H, W] uint8, a ``Reason``. NOISE pixels do have an S0 and a (small) DoLP: means of these over a region
            take them in; they say nothing of an angle or a normal.
        noise: of one sample of the sensor.
        pair_ratio: median of (I0 + I90) / (I45 + I135), which is 1 for ideal polarizers; None where it is too dark.
        notes: what was assumed, for the user.
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
