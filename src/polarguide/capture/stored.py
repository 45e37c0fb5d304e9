"""The views of a capture before the scene is made: what their stored values say of all of them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polarguide.capture import checks
from polarguide.capture.exposures import FOUR
from polarguide.capture.view_reader import ViewData
from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class StoredViews:
    """The views of a capture as read, with a pose or without.

    Attributes:
        data: the views, sorted by name.
        cameras: of each view at the size of its averaged pictures; None where the model has no pose.
        measures: ``checks.measure`` of each view.
        largest_value: the largest value that the files can store, 255 or 65535.
        full_scale: the stored value at which the capture saturates; None if nothing is saturated.
    """

    data: tuple[ViewData, ...]
    cameras: tuple[Camera | None, ...]
    measures: tuple[checks.Measures, ...]
    largest_value: int
    full_scale: int | None

    @classmethod
    def of(cls, data: Sequence[ViewData], cameras: Sequence[Camera | None]) -> StoredViews:
        """Measure views, and find where they saturate.

        Raises:
            PolarguideError: they differ in depth.
        """
        largest_value = _largest_value(data)
        scale = checks.full_scale(np.sum([item.histogram for item in data], axis=0), largest_value)
        measures = [
            checks.measure(item.codes, ~(item.invalid | item.saturated(scale)), four=item.exposures == FOUR)
            for item in data
        ]
        return cls(tuple(data), tuple(cameras), tuple(measures), largest_value, scale)

    def picture_warnings(self, transfer: str) -> list[str]:
        """Warnings about the exposure, encoding and order of the pictures."""
        names, scale = [item.name for item in self.data], self.full_scale
        blown = [0.0 if scale is None else float((item.peak >= scale).mean()) for item in self.data]
        largest = max(int(item.peak.max()) for item in self.data)
        warnings = checks.exposure_warnings(names, self.measures, blown, largest, self.largest_value)
        return warnings + checks.polarization_warnings(names, self.measures, transfer)


def _largest_value(data: Sequence[ViewData]) -> int:
    """The largest value of the views' common type, 255 or 65535."""
    first = {item.peak.dtype.itemsize: item.name for item in reversed(data)}
    if len(first) > 1:
        raise PolarguideError(
            "pictures",
            expected="one number of bits for all views",
            found=f"8 bits in view {first[1]} and 16 in view {first[2]}",
            remedy="Export all pictures alike.",
        )
    return int(np.iinfo(data[0].peak.dtype).max)
