"""The figures of one region of one shot."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.measurement.fields import PERCENTILES
from polarguide.measurement.regions import Region
from polarguide.shots.maps import Reason, ShotMaps

Value = int | float | str | None
Floats = NDArray[np.floating[Any]]


def region_figures(maps: ShotMaps, region: Region, threshold: float) -> dict[str, Value]:
    """Counts, S0, DoLP and AoLP of a region; None where it has no pixel to take a figure from.

    Means and standard deviations (over n, not n - 1) are computed in float64. AoLP is axial: with doubled angles,
    C = mean cos 2a and S = mean sin 2a over usable pixels, R = sqrt(C^2 + S^2), the mean is atan2(S, C) / 2, the
    standard deviation sqrt(-2 ln R) / 2 (Mardia and Jupp 2000, "Directional Statistics").

    Args:
        maps: the shot. region: within its size.
        threshold: DoLP over which pixels count in ``dolp_share``.

    Returns:
        By ``Field.key``, ``pixels`` to ``aolp_concentration``; angles in degrees.
    """
    at = region.rows, region.columns
    reason = maps.reason[at]
    counts = [int(np.count_nonzero(reason == kind)) for kind in Reason]
    total = reason.size
    measured, usable = reason <= Reason.NOISE, reason == Reason.USABLE
    dolp = _chosen(maps.dolp_debiased[at], measured)
    return {
        "pixels": total,
        "usable": counts[Reason.USABLE],
        "noise": counts[Reason.NOISE],
        "dark": counts[Reason.DARK],
        "saturated": counts[Reason.SATURATED],
        "masked": counts[Reason.MASKED],
        "usable_share": counts[Reason.USABLE] / total,
        **_distribution("s0", _chosen(maps.s0[at], measured)),
        **_distribution("dolp", dolp),
        "dolp_threshold": threshold,
        "dolp_share": float(np.count_nonzero(dolp > threshold)) / dolp.size if dolp.size else None,
        **_angles(_chosen(maps.aolp[at], usable)),
    }


def _chosen(values: Floats, mask: NDArray[np.bool_]) -> Floats:
    return values.ravel() if mask.all() else values[mask]


def _distribution(key: str, values: Floats) -> dict[str, Value]:
    names = (f"{key}_mean", f"{key}_deviation", *(f"{key}_p{p}" for p in PERCENTILES))
    if not values.size:
        return dict.fromkeys(names)
    mean, deviation = (float(found[0, 0]) for found in cv2.meanStdDev(values))  # one pass, in float64
    return dict(zip(names, (mean, deviation, *map(float, np.percentile(values, PERCENTILES))), strict=True))


def _angles(aolp: Floats) -> dict[str, Value]:
    if not aolp.size:
        return dict.fromkeys(("aolp_mean", "aolp_deviation", "aolp_concentration"))
    mean, length = axial_mean(aolp)
    degrees = math.degrees(mean) % 180.0
    return {
        "aolp_mean": 0.0 if degrees == 180.0 else degrees,  # what is just below 0 is rounded to 180
        "aolp_deviation": math.degrees(math.sqrt(-2 * math.log(max(length, 1e-300)))) / 2,
        "aolp_concentration": length,
    }


def axial_mean(angles: Floats) -> tuple[float, float]:
    """Circular mean of angles modulo pi, in [-pi/2, pi/2], and the mean resultant length of the doubled ones."""
    doubled = 2 * angles
    cosine, sine = np.cos(doubled).mean(dtype=np.float64), np.sin(doubled).mean(dtype=np.float64)
    return math.atan2(sine, cosine) / 2, min(1.0, math.hypot(cosine, sine))
