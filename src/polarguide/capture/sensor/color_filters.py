"""Tell by the samples of raw mosaics whether the sensor has color filters."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.pattern import SENSORS
from polarguide.capture.sensor.radiometry import Levels
from polarguide.errors import PolarguideError

Kind = Literal["color", "monochrome"]
SIDE = 8
"""Pixels along a block that is looked at: 4 x 4 cells of polarizers."""
_FEWEST = 100
_DIFFERENT, _EQUAL = 0.02, 0.006
"""Median second differences of cells as a share of their mean: filters make them, chance does not."""
_STRONGER, _ALIKE, _SMALL = 1.5, 1.35, 0.004
"""Ratios of typical differences, across filters to within one; differences that count as none."""


def color_filters(blocks: NDArray[Any], saturation: float, floor: float = 0.0) -> Kind | None:
    """Whether 2x2 cells of polarizers lie behind a Bayer pattern of color filters.

    The sum over a cell's four angles is that of the light, whatever its polarization. In a Bayer pattern two of four
    cells are green, along one diagonal, and those along the other take turns in red and blue: second differences,
    which leave the gradients of the picture out, are then large in the same way everywhere. Without filters they are
    small, alike along both diagonals, and have no sign.

    Args:
        blocks: stored values [N, 8, 8] that begin with a cell.
        saturation: the value from which a sample is saturated. floor: the value without light.

    Returns:
        None where the samples do not tell: too few, too dark, or gray light on balanced filters.
    """
    lit = (blocks < saturation).all(axis=(1, 2))
    cells = blocks[lit].reshape(-1, 4, 2, 4, 2).sum(axis=(2, 4), dtype=np.float64) - 4 * floor
    mean = cells.mean(axis=(1, 2))
    # A cell in the noise of the read-out says nothing.
    bright = mean > 4 * (saturation - floor) / 200
    if bright.sum() < _FEWEST:
        return None
    c = cells[bright] / mean[bright, None, None]
    down = c[:, 0, 0] - 2 * c[:, 1, 1] + c[:, 2, 2]
    up = c[:, 0, 3] - 2 * c[:, 1, 2] + c[:, 2, 1]
    across = c[:, 0, 0] + c[:, 1, 1] - c[:, 0, 1] - c[:, 1, 0]
    signed = max(abs(float(np.median(difference))) / 2 for difference in (down, up, across))
    least, most = sorted(float(np.median(np.abs(difference))) for difference in (down, up))
    spread = max(most, float(np.median(np.abs(across)))) / max(least, _SMALL)
    if signed > _DIFFERENT and spread > _STRONGER:
        return "color"
    return "monochrome" if signed < _EQUAL and spread < _ALIKE else None


def require_kind(sensor: str, blocks: NDArray[Any], levels: Levels) -> None:
    """Refuse mosaics of the other kind of sensor: nothing later would tell.

    Args:
        sensor: its name, a key of ``SENSORS``. blocks: as for ``color_filters``. levels: of the stored values.

    Raises:
        PolarguideError: the samples say that it is another one.
    """
    found = color_filters(blocks, levels.saturation, levels.black)
    if found is None or (found == "color") == SENSORS[sensor]:
        return
    other = next(name for name, colored in SENSORS.items() if colored != SENSORS[sensor])
    raise PolarguideError(
        "--sensor",
        expected=f"mosaics of {sensor}, a {'color' if SENSORS[sensor] else 'monochrome'} sensor",
        found="no sign of color filters" if SENSORS[sensor] else "the Bayer pattern of color filters",
        remedy=f"Use --sensor {other}, or that of your camera with this pattern.",
    )
