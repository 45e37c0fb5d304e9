"""What a source of pictures offers, whatever its format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.colmap.write import PosedCamera
from polarguide.progress import Advance


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

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Find out what holds for the whole capture, as JSON types; ``notes`` are sentences for the user."""

    def develop(self, view: str, measured: dict[str, Any]) -> Developed:
        """Read one view."""
