"""The pattern of polarizers and color filters of a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.errors import PolarguideError

_CELL = np.array([[90, 45], [135, 0]])
_BAYER = np.array([[0, 1], [1, 2]])  # R G / G B, one entry a polarizer cell

SENSORS = {"IMX250MYR": True, "IMX264MYR": True, "IMX250MZR": False}
"""Sony sensors by name, and whether they are color sensors."""

SENSOR_SIZE = (2464, 2056)
"""Width and height of all of them, in pixels; cameras give 2448 x 2048."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """The repeating pattern of a sensor or of a region of it.

    Attributes:
        angles: polarizer angle of each pixel in degrees, [4, 4] for a color sensor, [2, 2] for a monochrome one.
        colors: 0, 1, 2 for R, G, B in the same shape, or None for a monochrome sensor.
    """

    angles: NDArray[np.int64]
    colors: NDArray[np.int64] | None

    @property
    def period(self) -> int:
        """Pixels after which the pattern repeats, each way: 4 or 2."""
        return int(self.angles.shape[0])

    def shifted(self, x: int, y: int) -> Pattern:
        """The pattern of a region whose top-left pixel is column ``x``, row ``y`` of this one."""
        return Pattern(
            np.roll(self.angles, (-y, -x), axis=(0, 1)),
            None if self.colors is None else np.roll(self.colors, (-y, -x), axis=(0, 1)),
        )

    def cell_corner(self) -> tuple[int, int]:
        """Columns and rows to cut so that the region starts with a whole polarizer cell of one color.

        A monochrome pattern needs none: any 2x2 pixels hold all four angles.
        """
        if self.colors is None:
            return 0, 0
        x = 0 if (self.colors[:, 0] == self.colors[:, 1]).all() else 1
        y = 0 if (self.colors[0] == self.colors[1]).all() else 1
        return x, y

    def rows(self) -> list[str]:
        """The pattern as text, one string per row: "R90 R45 G90 G45", ..."""
        names = self.angles.astype(str).astype(object)
        if self.colors is not None:
            names = np.array(list("RGB"), dtype=object)[self.colors] + names
        return [" ".join(row) for row in names]


def tiled(pattern: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """A pattern repeated over [H, W]."""
    repeat = [-(-length // period) for length, period in zip(shape, pattern.shape, strict=True)]
    return np.tile(pattern, repeat)[: shape[0], : shape[1]]


def sensor_pattern(sensor: str) -> Pattern:
    """The pattern of a whole sensor, from its top-left pixel.

    Raises:
        PolarguideError: the sensor is unknown.
    """
    if sensor not in SENSORS:
        raise PolarguideError(
            "--sensor",
            expected=f"one of {', '.join(SENSORS)}",
            found=repr(sensor),
            remedy="Cameras with the same pattern as one of them are read under its name.",
        )
    if not SENSORS[sensor]:
        return Pattern(_CELL.copy(), None)
    return Pattern(np.tile(_CELL, (2, 2)), np.kron(_BAYER, np.ones((2, 2), int)))
