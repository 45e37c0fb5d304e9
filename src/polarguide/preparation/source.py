"""The interface of picture sources of all formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.polarizer_angles import Angle
from polarguide.polarizer import ANGLES
from polarguide.progress import Advance


@dataclass(frozen=True, eq=False)
class DevelopedView:
    """The developed picture of one view.

    Attributes:
        intensities: [4, H, W, 3] float32 in [0, 1], linear, at 0, 45, 90 and 135 degrees; or [K, H, W, 3].
        invalid: pixels that depend on an unusable sample, [H, W].
        geometry: crop and scale relative to the stored picture.
        mask: object mask, [H, W], or None.
        angles: of the pictures, counter-clockwise as displayed.
        record: measurements for ``scene.json``.
        notes: messages for the user.
    """

    intensities: NDArray[np.float32]
    invalid: NDArray[np.bool_]
    geometry: Geometry
    record: dict[str, Any]
    notes: tuple[str, ...] = ()
    mask: NDArray[np.bool_] | None = None
    angles: Sequence[Angle] = ANGLES


class Source(Protocol):
    """The pictures of one capture.

    Attributes:
        kind: name of the format.
        cameras: by view name, if the source has poses, else None.
        views: view names, sorted.
        paths: all files that are read.
        needs: keys of what ``measure`` returns that ``develop`` reads.
    """

    needs: tuple[str, ...]
    kind: str
    cameras: Mapping[str, PosedCamera] | None
    views: list[str]
    paths: list[Path]

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Measure what is common to the whole capture, as JSON types; ``notes`` are messages for the user."""

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one view."""
