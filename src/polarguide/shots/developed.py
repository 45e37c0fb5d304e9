"""Intensities of a shot before anything is derived from them, and the gains of its four pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import UNIT_GAINS, balancing_gains
from polarguide.shots.maps import Map, NoiseModel
from polarguide.shots.options import ShotOptions

Mask = NDArray[np.bool_]
_LARGE_IMBALANCE = 0.01


@dataclass(frozen=True, eq=False)
class Developed:
    """Intensities of a shot before anything is derived from them.

    Attributes:
        intensities: [4, H, W, C] float32, linear; noise about black may be negative.
        dark, saturated, masked: [H, W].
        noise: of a sample. factors: variance of an intensity (of the luminance) as a multiple of a sample's,
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


def gains_of(
    ratio: float | None, options: ShotOptions
) -> tuple[tuple[float, float, float, float], tuple[str, ...]]:
    """Gains of the four pictures, and what to say of them."""
    if options.analyzers is not None:
        if ratio is None:
            return UNIT_GAINS, ()
        notes = [f"With the calibration, I0 + I90 is {ratio - 1:+.2%} off I45 + I135."]
        if abs(ratio - 1) > _LARGE_IMBALANCE:
            notes.append("That is more than a calibration of this camera leaves: is it one of another?")
        return UNIT_GAINS, tuple(notes)
    if options.calibration.gains is not None:
        return options.calibration.gains, ()
    if ratio is None:
        return UNIT_GAINS, ()
    said = f"I0 + I90 is {ratio - 1:+.2%} off I45 + I135"
    found = balancing_gains(ratio)
    if found is None:
        return UNIT_GAINS, (f"{said}: the angles or the encoding are probably wrong.",)
    if options.gains == "auto":
        return found, (f"{said}; corrected.",)
    if abs(ratio - 1) > _LARGE_IMBALANCE:
        return UNIT_GAINS, (f"{said}; not corrected (--gains auto does, a calibration does better).",)
    return UNIT_GAINS, ()
