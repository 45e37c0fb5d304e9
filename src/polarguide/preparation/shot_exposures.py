"""Exposures of the four shots of a view, as their files state and as their pair sums measure; bits and full scale of
shots whose 16-bit files do not state them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Gains
from polarguide.capture.checks import measured_gains, pair_moments
from polarguide.capture.filter.camera_files import (
    ExposureData,
    is_camera_raw,
    missing_tags,
    read_exposure_data,
)
from polarguide.capture.filter.shots import read_stack
from polarguide.capture.formats.pictures import may_use_fewer_bits
from polarguide.capture.sensor.pattern import FULL_16, Levels, estimate_levels, level_notes
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES
from polarguide.preparation.settings import PrepareSettings

# Logarithm of a ratio of exposures that are the same: files state three digits.
_EQUAL = 1e-3


def stated_exposures(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[str, list[float]], str]:
    """Relative exposures that the files of views state (EXIF), their geometric mean over all of these views 1.

    Args:
        views: the files of each.
        advance: receives the number of views that were read.

    Returns:
        Those of all views; nothing where all state the same, or where files do not state the same tags. And a sentence
        for the user in that last case, else "".

    Raises:
        PolarguideError: a file cannot be read.
    """
    taken: dict[Path, ExposureData] = {}
    for number, paths in enumerate(views.values(), 1):
        taken |= {path: read_exposure_data(path) for path in paths}
        if advance is not None:
            advance(number)
    missing = missing_tags(taken)
    logs = {path: math.log(light) for path, data in taken.items() if (light := data.light) is not None}
    if missing or not logs or max(logs.values()) - min(logs.values()) < _EQUAL:
        return {}, missing
    mean = sum(logs.values()) / len(logs)
    return {view: [math.exp(logs[path] - mean) for path in paths] for view, paths in views.items()}, ""


def exposure_notes(stated: Mapping[str, Sequence[float]]) -> list[str]:
    """The exposures that the files state, in a sentence for the user."""
    if not stated:
        return []
    every = [value for of_view in stated.values() for value in of_view]
    stops = math.log2(max(every) / min(every))
    within = sum(math.log(max(mine) / min(mine)) >= _EQUAL for mine in stated.values())
    return [
        f"Exposures differ by up to {stops:.2f} stops by EXIF, in {within} views from shot to shot: taken back "
        "(--gains none leaves them)."
    ]


@dataclass(frozen=True)
class ShotExposures:
    """Exposures of the shots of a view.

    Attributes:
        gains: by which the shots are divided.
        warning: where the pair sums contradict what the files state; empty where they do not.
    """

    gains: Gains
    warning: str = ""


def exposures_of_view(
    names: Sequence[str], gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_], stated: Sequence[float]
) -> ShotExposures:
    """The exposures of four shots: as their files state, unless their pair sums surely say otherwise.

    Args:
        names: names of the shots, for messages.
        gray: linear intensities [4, H, W]. usable: [H, W].
        stated: exposures that the files state, or ones.
    """
    logs = np.log(np.asarray(stated, np.float64))
    mean = float(logs.mean())
    measured = measured_gains(pair_moments(gray, usable))
    off = {} if measured is None else measured.deviating(list(logs - mean))
    if measured is None or not off:
        return ShotExposures(_gains(logs))
    differ = float(np.ptp(logs)) >= _EQUAL
    named = ", ".join(
        f"{names[ANGLES.index(angle)]} ({angle} degrees) by {factor - 1:+.0%}"
        for angle, factor in off.items()
    )
    than = "than their EXIF exposures say" if differ else "than the other shots of the view"
    warning = (
        f"exposed otherwise {than}, by the pair sums: {named}. The pair sums are believed. Automatic exposure, edited "
        "pictures, or a filter that was not turned?"
    )
    return ShotExposures(_gains(np.asarray(measured.logs) + mean), warning)


def _gains(logs: NDArray[np.float64]) -> Gains:
    first, second, third, fourth = (float(value) for value in np.exp(logs))
    return first, second, third, fourth


def levels_of_shots(
    paths: Sequence[Path], white: tuple[float, float, float], settings: PrepareSettings
) -> tuple[Levels | None, list[str]]:
    """Levels of the stored values where the files do not state them, and notes for the user.

    Args:
        paths: all files of the capture. white: gains of R, G and B, for camera raw files.
        settings: ``bits`` and ``saturation``.

    Returns:
        None where every file states its full scale, and nothing else is given.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    wide = [path for path in paths if not is_camera_raw(path) and may_use_fewer_bits(path)]
    if not wide and settings.bits is None and settings.saturation is None:
        return None, []
    counts, container = np.zeros(FULL_16 + 1, np.int64), 8
    for path in wide or paths:
        values = read_stack([path], white).pictures
        container = 8 * values.dtype.itemsize
        counts += np.bincount(values.ravel(), minlength=len(counts))
    occurring = np.flatnonzero(counts)
    levels = estimate_levels(
        int(occurring[-1]), int(np.bitwise_or.reduce(occurring)), container,
        bits=settings.bits, black=0.0, saturation=settings.saturation, counts=counts,
    )  # fmt: skip
    usual = levels.bits == container and levels.saturation == levels.white
    return levels, [] if usual else level_notes(levels, counts, container, settings.bits)
