"""What a source of pictures offers, whatever its format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.posed_camera import PosedCamera


@dataclass(frozen=True)
class Geometry:
    """How a developed picture lies in the stored one: developed = (stored - crop) / step, in pixels from the corner.

    Attributes:
        stored: width and height of the stored picture, as displayed.
        crop: columns and rows cut at the left and top.
        step: stored pixels per developed pixel.
        size: width and height of the developed picture.
    """

    stored: tuple[int, int]
    crop: tuple[int, int]
    step: int
    size: tuple[int, int]

    def record(self) -> dict[str, Any]:
        """As plain JSON types."""
        return {
            "stored": list(self.stored), "crop": list(self.crop), "step": self.step, "size": list(self.size)
        }  # fmt: skip

    @classmethod
    def of(cls, record: dict[str, Any]) -> Geometry:
        """What ``record`` made."""
        stored, crop, size = ((int(x), int(y)) for x, y in (record[n] for n in ("stored", "crop", "size")))
        return cls(stored, crop, int(record["step"]), size)


@dataclass(frozen=True, eq=False)
class Developed:
    """One view.

    Attributes:
        intensities: [4, H, W, 3] float32 in [0, 1], linear, at 0, 45, 90 and 135 degrees.
        invalid: pixels that used a sample without meaning, [H, W].
        geometry: where it lies in the stored picture.
        mask: the object, [H, W], where the source brings one.
        record: what was found, for ``scene.json``.
        notes: sentences for the user.
    """

    intensities: NDArray[np.float32]
    invalid: NDArray[np.bool_]
    geometry: Geometry
    record: dict[str, Any]
    notes: tuple[str, ...] = ()
    mask: NDArray[np.bool_] | None = None


class Source(Protocol):
    """Pictures of one format."""

    @property
    def kind(self) -> str:
        """Name of the format."""

    @property
    def cameras(self) -> Mapping[str, PosedCamera] | None:
        """Cameras by view name, where the source brings poses."""

    @property
    def views(self) -> list[str]:
        """View names, sorted."""

    @property
    def paths(self) -> list[Path]:
        """All files that are read."""

    def measure(self, advance: Callable[[int], None]) -> dict[str, Any]:
        """Find out what holds for the whole capture, as JSON types; ``notes`` are sentences for the user."""

    def develop(self, view: str, measured: dict[str, Any]) -> Developed:
        """Read one view."""
