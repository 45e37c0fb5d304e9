"""Picture source: four shots per view through a rotating polarizing filter."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.capture.calibration import (
    LARGEST_IMBALANCE,
    UNIDENTIFIED,
    UNIT_GAINS,
    balancing_gains,
    oriented,
    pair_ratio,
)
from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.filter.align import Shift, align_shots, estimate_shifts
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.exif import apply_orientation, orientation_calibration
from polarguide.capture.filter.shots import find_shots, list_shots, read_shots, require_four_shots
from polarguide.capture.filter.transfer import decide_transfer, linear_intensities, rounding_of_bytes
from polarguide.capture.memory import require_memory_of_each
from polarguide.capture.view import ANGLES, listed
from polarguide.capture.write import EXACT, Rounding
from polarguide.errors import PolarguideError, PolarguideWarning
from polarguide.preparation.settings import PrepareSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source
from polarguide.progress import Advance

_JUDGED_VIEWS = 8
_WORKED = 4 * 3 * (2 + 2 + 4 + 4 + 4)
"""Bytes for each pixel of four shots: as stored and stacked, linear, aligned, turned."""


class FilterSource(Source):
    """Shots of an ordinary camera through a rotating linear polarizer."""

    kind = "filter"
    needs = ("transfer", "scale")
    cameras = None

    def __init__(self, root: Path, settings: PrepareSettings) -> None:
        self._settings = settings
        shots = find_shots(root, nested=True)
        require_four_shots(root, shots)
        unused = [path.name for path in list_shots(root, nested=True)[1]]
        unused += [path.name for files in shots.values() for a, path in files.items() if a not in ANGLES]
        if unused:
            found = f"{root} has pictures without an angle in their names, or at other angles than 0, 45, 90 and 135"
            warnings.warn(f"{found}, which are not used ({listed(unused)}).", PolarguideWarning, stacklevel=2)
        self._files = dict(sorted(shots.items()))
        self.views = list(self._files)
        self.paths = [files[angle] for files in self._files.values() for angle in ANGLES]
        self._raw = [path for path in self.paths if is_camera_raw(path)]
        self._white = development_of(self.paths, settings)

    def _require_memory(self) -> None:
        """Refuse shots that do not fit into memory, from their headers alone.

        Raises:
            PolarguideError: the largest is too large.
        """
        remedy = "Make the pictures smaller, all by the same factor."
        require_memory_of_each(self.paths, _WORKED, "four shots", remedy=remedy)

    def measure(self, advance: Advance) -> dict[str, Any]:
        """The transfer of the capture, from a few views spread over it."""
        self._require_memory()
        asked = self._settings
        notes: list[str] = []
        transfer: str = asked.transfer
        if transfer == "auto" and len(self._raw) == len(self.paths):
            transfer = "linear"
            notes.append("Transfer linear: camera raw, developed without tone curve, alike for all shots.")
        if transfer == "auto":
            step = max(1, math.ceil(len(self._files) / _JUDGED_VIEWS))
            judged = []
            for view in self.views[::step]:
                judged.append(read_shots(self._files[view], self._white))
                advance(len(judged) * step)
            suffix = self.paths[0].suffix.lower()
            decision = decide_transfer(judged, jpeg=suffix in (".jpg", ".jpeg"))
            transfer = decision.transfer
            notes.append(f"Transfer {decision.reason}.")
        if asked.calibration.gains is not None:
            scale = min(1.0, *asked.calibration.gains)
        else:
            # One scale for all shots, with room for the largest gain that is corrected.
            scale = math.sqrt(1.0 - LARGEST_IMBALANCE) if asked.gains == "auto" else 1.0
            notes += [UNIDENTIFIED] if asked.gains == "auto" else []
        scale /= asked.calibration.peak
        return {
            "transfer": transfer,
            "scale": scale,
            "rounding": self._rounding(transfer, scale),
            "notes": notes,
        }

    def _rounding(self, transfer: str, scale: float) -> Rounding:
        """What codes are rounded to: by the steps of 8-bit values, which grow with sRGB's; none for 16 bits."""
        stored = read_shots(self._files[self.views[0]], self._white).pictures
        if self._settings.precision == "full" or stored.dtype != np.uint8:
            return EXACT
        gains = self._settings.calibration.gains
        smallest = scale / (max(gains) if gains is not None else 1.0 / math.sqrt(1.0 - LARGEST_IMBALANCE))
        return rounding_of_bytes(transfer, smallest)

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read the four shots: validity, transfer, shifts, gains, the sense of the angles, then the turn."""
        asked = self._settings
        shots = read_shots(self._files[view], self._white)
        linear, bad = linear_intensities(shots.pictures, measured["transfer"]), shots.clipped | shots.dark
        shifts, notes = [Shift(0.0, 0.0, True)] * 4, []
        if asked.align:
            shifts = estimate_shifts(linear)
            linear, bad = align_shots(linear, bad, shifts)
            notes = shift_notes(view, shifts)
        invalid = np.asarray(bad.any(axis=0))
        ratio = pair_ratio(linear.mean(axis=3), ~invalid)
        gains = asked.calibration.gains or UNIT_GAINS
        if asked.calibration.gains is None and asked.gains == "auto":
            found = balancing_gains(ratio)
            gains = found or UNIT_GAINS
            if found is None:
                said = (
                    "is too dark to measure"
                    if ratio is None
                    else f"is off by {ratio - 1:+.1%}, too much for gains"
                )
                notes.append(f"{view}: (I0 + I90)/(I45 + I135) {said}; not corrected.")
        factors = np.asarray(measured["scale"] / np.asarray(gains), np.float32)
        linear = oriented(linear * factors[:, None, None, None], asked.calibration)
        turned = np.stack([apply_orientation(picture, shots.orientation) for picture in linear])
        upright = np.ascontiguousarray(oriented(turned, orientation_calibration(shots.orientation)))
        height, width = upright.shape[1:3]
        return DevelopedView(
            intensities=upright,
            invalid=np.ascontiguousarray(apply_orientation(invalid, shots.orientation)),
            geometry=Geometry((width, height), (0, 0), 1, (width, height)),
            record={
                "orientation": shots.orientation,
                "shifts": [[shift.x, shift.y] for shift in shifts],
                "shifts_corrected": [shift.corrected for shift in shifts],
                "pair_ratio": ratio,
                "gains": list(gains),
                "clipped_share": round(float(shots.clipped.any(axis=0).mean()), 6),
                "dark_share": round(float(shots.dark.mean()), 6),
                "invalid_share": round(float(invalid.mean()), 6),
            },
            notes=tuple(notes),
        )


def development_of(paths: Sequence[Path], settings: PrepareSettings) -> tuple[float, float, float]:
    """Gains of R, G and B for camera raw, after a check that white balance and transfer fit the files.

    Raises:
        PolarguideError: one does not.
    """
    raw = [path for path in paths if is_camera_raw(path)]
    white = white_gains(settings.white_balance)
    if white is None or (white != (1.0, 1.0, 1.0) and len(raw) < len(paths)):
        raise PolarguideError(
            "--white-balance",
            expected="none for pictures; none or three gains for camera raw",
            found=settings.white_balance,
            remedy="Omit it.",
        )
    if raw and settings.transfer == "srgb":
        raise PolarguideError(
            "--transfer",
            expected="auto or linear for camera raw, which is developed without tone curve",
            found="srgb",
            remedy="Omit it.",
        )
    return white


def shift_notes(view: str, shifts: list[Shift]) -> list[str]:
    """Notes about shots that were shifted, and about shots without a reliable estimate."""
    named = list(zip(ANGLES, shifts, strict=True))
    moved = [f"{angle} by ({-shift.x:+.2f}, {-shift.y:+.2f})" for angle, shift in named if shift.corrected]
    doubtful = [str(angle) for angle, shift in named if not shift.trusted]
    notes = [f"{view}: shots moved, in pixels: {', '.join(moved)}."] if moved else []
    if doubtful:
        notes.append(f"{view}: no reliable shift of the shots at {', '.join(doubtful)}; used as they are.")
    return notes
