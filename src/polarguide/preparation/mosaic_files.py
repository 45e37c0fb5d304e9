"""Raw mosaics of one sensor: reading them, cutting them to whole cells, their dark frame and their kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.memory import require_memory, require_memory_of_each
from polarguide.capture.sensor.color_filters import require_kind
from polarguide.capture.sensor.pattern import SENSORS, sensor_pattern
from polarguide.capture.sensor.radiometry import Levels
from polarguide.capture.sensor.raw_file import RawFormat, read_mosaic
from polarguide.errors import PolarguideError
from polarguide.preparation.settings import PrepareSettings

SMALLEST = 16
"""Pixels of the shorter side of a mosaic."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Bytes that a pixel of the sensor takes at least while a mosaic is developed, by the mode of demosaicing."""


class MosaicFiles:
    """How the mosaics of one sensor are read.

    Attributes:
        pattern: of the top-left pixel that is left after ``cut``.
        crop: columns and rows that ``cut`` takes off.
    """

    def __init__(self, settings: PrepareSettings) -> None:
        """Take sensor, region, packing and dark frame from the settings.

        Raises:
            PolarguideError: the sensor is not named.
        """
        if settings.sensor is None:
            raise PolarguideError(
                "--sensor",
                expected=f"the sensor of raw mosaics: {', '.join(SENSORS)}",
                found="none",
                remedy="Name it; color (MYR) and monochrome (MZR) sensors have different patterns.",
            )
        self._settings = settings
        self._raw = RawFormat(settings.width, settings.height, settings.packing)
        pattern = sensor_pattern(settings.sensor).shifted(settings.offset_x, settings.offset_y)
        self.crop = pattern.cell_corner()
        self.pattern = pattern.shifted(*self.crop)

    def read(self, path: Path) -> NDArray[Any]:
        """The stored values of a whole mosaic, [H, W].

        Raises:
            PolarguideError: the file cannot be read, is too small, or does not fit into memory when it is developed.
        """
        worked, raw = WORKED[self._settings.demosaic], self._raw
        remedy = "Give a region of the sensor, or choose --demosaic half or quarter."
        if path.suffix.lower() != ".raw":
            require_memory_of_each([path], worked, "a mosaic", remedy=remedy)
        elif raw.width is not None and raw.height is not None:
            what = f"a mosaic of {raw.width}x{raw.height}"
            require_memory(path, worked * raw.width * raw.height, what, remedy=remedy)
        return read_mosaic(path, self._raw, least=SMALLEST)

    def container(self, path: Path, values: NDArray[Any]) -> int:
        """Bits that a pixel takes in the file."""
        return self._raw.container(path, values.dtype)

    def require_kind(self, blocks: NDArray[Any], levels: Levels) -> None:
        """Refuse mosaics of the other kind of sensor: nothing later would tell."""
        assert self._settings.sensor is not None
        require_kind(self._settings.sensor, blocks, levels)

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop to whole cells."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """The dark frame, cut like the mosaics."""
        if self._settings.dark_frame is None:
            return None
        dark = read_mosaic(self._settings.dark_frame, self._raw)
        if dark.shape != shape:
            raise PolarguideError(
                self._settings.dark_frame,
                expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
                found=f"{dark.shape[1]}x{dark.shape[0]}",
                remedy="Take it with the same region and settings, the lens covered.",
            )
        return self.cut(dark).astype(np.float32)
