"""Picture source: photographs through a filter at any angles, one or several a view."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.filter.align import align_shots, estimate_shifts
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.exif import apply_orientation, orientation_calibration
from polarguide.capture.filter.exif_exposure import read_taken
from polarguide.capture.filter.shots import read_stack
from polarguide.capture.filter.single_shots import SingleShot, find_single_shots
from polarguide.capture.filter.transfer import linear_intensities, rounding_of_bytes
from polarguide.capture.formats.headers import stated_size
from polarguide.capture.memory import require_memory_of_each
from polarguide.capture.polarizer_angles import Angle, angle_text, turned
from polarguide.capture.view import ANGLES, listed
from polarguide.capture.write import EXACT, Rounding
from polarguide.errors import PolarguideError
from polarguide.preparation.filter_source import development_of, shift_notes
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.source import DevelopedView, Source
from polarguide.progress import Advance

_WORKED = 3 * (2 + 2 + 4 + 4 + 4)
"""Bytes for each pixel of a shot: as stored and stacked, linear, turned, written."""
_JPEG = (".jpg", ".jpeg")


class SinglesSource(Source):
    """Photographs of one camera through a linear polarizer that was turned between them, or without one."""

    needs = ("transfer", "scale", "light")
    kind = "singles"
    cameras = None

    def __init__(self, root: Path, settings: PrepareSettings) -> None:
        """Find the photographs and their angles.

        Raises:
            PolarguideError: one has no angle, or the settings do not fit the files.
        """
        self._root, self._settings = root, settings
        shots, tables = find_single_shots(root, settings.angles)
        self._shots: dict[str, list[SingleShot]] = {}
        for shot in shots:
            self._shots.setdefault(shot.view, []).append(shot)
        self.views = sorted(self._shots)
        self._pictures = [shot.path for view in self.views for shot in self._shots[view]]
        self.paths = [*self._pictures, *tables]
        self._white = development_of(self._pictures, settings)

    def measure(self, advance: Advance) -> dict[str, Any]:
        """The transfer, and what the files say about their exposure.

        Raises:
            PolarguideError: the photographs are too large, or not of one camera and size.
        """
        most = max(map(len, self._shots.values()))
        remedy = "Make the pictures smaller, all by the same factor."
        require_memory_of_each(self._pictures, most * _WORKED, "photographs of a view", remedy=remedy)
        self._require_one_size()
        transfer, reason = self._transfer()
        light: dict[str, float] = {}
        cameras: dict[str, Path] = {}
        for number, view in enumerate(self.views, 1):
            for shot in self._shots[view]:
                taken = read_taken(shot.path)
                if taken.camera:
                    cameras.setdefault(taken.camera, shot.path)
                if taken.light is not None:
                    light[self._name(shot)] = taken.light
            advance(number)
        if len(cameras) > 1:
            (first, path), (second, other) = list(cameras.items())[:2]
            raise PolarguideError(
                self._root,
                expected="photographs of one camera",
                found=f"{first} ({path.name}) and {second} ({other.name})",
                remedy="Prepare those of one camera; only one set of intrinsics is estimated.",
            )
        return {
            "transfer": transfer,
            "scale": 1.0,
            "rounding": self._rounding(transfer),
            "light": light,
            "notes": [self._summary(), reason, self._said_of_exposure(len(light))],
        }

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read the shots of a view: validity, transfer, shifts of the usual four, the turn of pictures and angles."""
        asked, mine = self._settings, self._shots[view]
        shots = read_stack([shot.path for shot in mine], self._white)
        linear, bad = linear_intensities(shots.pictures, measured["transfer"]), shots.clipped | shots.dark
        notes: list[str] = []
        if asked.align and [shot.angle for shot in mine] == list(ANGLES):
            shifts = estimate_shifts(linear)
            linear, bad = align_shots(linear, bad, shifts)
            notes = shift_notes(view, shifts)
        code = shots.orientation
        upright = np.stack([apply_orientation(picture, code) for picture in linear])
        invalid = np.asarray(bad.any(axis=0))
        height, width = upright.shape[1:3]
        angles = [
            turned(turned(shot.angle, asked.calibration), orientation_calibration(code)) for shot in mine
        ]
        exposures = [
            {
                "source": self._name(shot),
                "angle": angle,
                "light": measured["light"].get(self._name(shot)),
                "given_gain": shot.gain,
            }
            for shot, angle in zip(mine, angles, strict=True)
        ]
        return DevelopedView(
            intensities=np.ascontiguousarray(upright),
            invalid=np.ascontiguousarray(apply_orientation(invalid, code)),
            geometry=Geometry((width, height), (0, 0), 1, (width, height)),
            angles=angles,
            record={
                "orientation": code,
                "exposures": exposures,
                "clipped_share": round(float(shots.clipped.any(axis=0).mean()), 6),
                "dark_share": round(float(shots.dark.mean()), 6),
                "invalid_share": round(float(invalid.mean()), 6),
            },
            notes=tuple(notes),
        )

    def _name(self, shot: SingleShot) -> str:
        """A photograph's name in its folder."""
        return shot.path.relative_to(self._root).as_posix()

    def _require_one_size(self) -> None:
        """Refuse photographs whose headers state several sizes, but for the side they were held on.

        Raises:
            PolarguideError: there are several.
        """
        sizes: dict[tuple[int, int], Path] = {}
        for path in self._pictures:
            size = None if is_camera_raw(path) else stated_size(path)
            if size is not None:
                sizes.setdefault((max(size), min(size)), path)
        if len(sizes) > 1:
            (first, path), (second, other) = list(sizes.items())[:2]
            raise PolarguideError(
                self._root,
                expected="photographs of one size",
                found=f"{first[0]}x{first[1]} ({path.name}) and {second[0]}x{second[1]} ({other.name})",
                remedy="Export all pictures of one camera alike, without a crop.",
            )

    def _transfer(self) -> tuple[str, str]:
        """How the files are encoded, and why.

        Raises:
            PolarguideError: they are of several kinds.
        """
        asked = self._settings.transfer
        kinds = {
            "camera raw" if is_camera_raw(path) else "JPEG" if path.suffix.lower() in _JPEG else "PNG or TIFF"
            for path in self._pictures
        }
        if len(kinds) > 1:
            raise PolarguideError(
                self._root,
                expected="photographs of one kind of file",
                found=" and ".join(sorted(kinds)),
                remedy="Keep one kind: their brightness cannot be compared.",
            )
        (kind,) = kinds
        if kind == "camera raw":
            return "linear", "Transfer linear: camera raw, developed without tone curve, alike for all shots."
        if asked != "auto":
            return asked, f"Transfer {asked}, as given."
        found = "srgb" if kind == "JPEG" else "linear"
        return found, f"Transfer {found}, as {kind} files usually are (--transfer sets it)."

    def _rounding(self, transfer: str) -> Rounding:
        """What codes are rounded to: by the steps of 8-bit values; none for 16 bits."""
        first = self._shots[self.views[0]][0]
        if (
            self._settings.precision == "full"
            or read_stack([first.path], self._white).pictures.dtype != np.uint8
        ):
            return EXACT
        return rounding_of_bytes(transfer, 1.0)

    def _summary(self) -> str:
        """How many photographs there are, and at which angles."""
        shots = [shot for view in self.views for shot in self._shots[view]]
        counts = Counter(_rough(turned(shot.angle, self._settings.calibration)) for shot in shots)
        words = [counts.pop(word, 0) for word in ("unknown", "none")]
        angles = [angle_text(angle) for angle in sorted(a for a in counts if not isinstance(a, str))]
        parts = [f"{sum(counts.values())} at known angles ({listed(angles, 12)})"] if angles else []
        parts += [f"{words[0]} at unknown angles"] if words[0] else []
        parts += [f"{words[1]} without a filter"] if words[1] else []
        return f"{len(shots)} photographs of {len(self.views)} views: {', '.join(parts)}."

    def _said_of_exposure(self, count: int) -> str:
        """How many files state their exposure."""
        whole = len(self._pictures)
        if count == whole:
            return "All files state their exposure (EXIF)."
        return f"{count or 'None'} of {whole} files state their exposure (EXIF)."


def _rough(angle: Angle) -> Angle:
    return angle if isinstance(angle, str) else round(angle, 1) % 180
