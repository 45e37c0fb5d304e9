"""Bits and full scale of shots whose 16-bit files do not state them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.shots import read_stack
from polarguide.capture.formats.pictures import may_use_fewer_bits
from polarguide.capture.sensor.pattern import FULL_16, Levels, estimate_levels, level_notes
from polarguide.preparation.settings import PrepareSettings


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
