"""Picture sources: photographs through a polarizing filter, four shots a view or single ones at any angles."""

from __future__ import annotations

import math
import warnings
from collections import Counter
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
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.exposures import Angle, angle_text, turned
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.develop import (
    Shift,
    align_shots,
    decide_transfer,
    estimate_shifts,
    linear_intensities,
    rounding_of_bytes,
)
from polarguide.capture.filter.exif import apply_orientation, orientation_calibration, read_taken
from polarguide.capture.filter.shots import (
    SingleShot,
    find_shots,
    find_single_shots,
    list_shots,
    read_shots,
    read_stack,
    require_four_shots,
)
from polarguide.capture.formats.pictures import stated_size
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


_WORKED_SINGLE = 3 * (2 + 2 + 4 + 4 + 4)
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
        require_memory_of_each(self._pictures, most * _WORKED_SINGLE, "photographs of a view", remedy=remedy)
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
