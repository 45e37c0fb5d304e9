"""Picture sources: photographs through a polarizing filter, four shots a view or single ones at any angles."""

from __future__ import annotations

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import LARGEST_IMBALANCE, pair_ratio
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.develop import (
    COMPARABLE,
    LinearShots,
    as_displayed,
    exposure_notes,
    levels_of_pictures,
    light_of_files,
    pair_gains,
    require_one,
    stated_exposures,
)
from polarguide.capture.exposures import Angle, angle_text, turned
from polarguide.capture.filter.camera_files import (
    Lens,
    apply_orientation,
    camera_groups,
    is_camera_raw,
    orientation,
    orientation_calibration,
    stored_frame,
)
from polarguide.capture.filter.develop import rounding_of_bytes, shift_notes
from polarguide.capture.filter.encoding import (
    TransferDecision,
    kind_of_file,
    transfer_of_pictures,
)
from polarguide.capture.filter.shots import (
    SingleShot,
    find_shots,
    find_single_shots,
    list_shots,
    read_stack,
    require_four_shots,
)
from polarguide.capture.formats.pictures import read_picture, stated_size
from polarguide.capture.layout import require_memory_of_each
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES, listed
from polarguide.capture.write import EXACT, Rounding
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.progress import Advance
from polarguide.preparation.journal import (
    ExposureRecord,
    Factor,
    Measured,
    StoredRounding,
    ViewRecord,
)
from polarguide.preparation.settings import FilterSettings, SinglesSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source, Stored

_JUDGED_VIEWS = 8
_GAINS = {
    "dark": "(I0 + I90)/(I45 + I135) is too dark to measure; not corrected.",
    "off": "(I0 + I90)/(I45 + I135) is off by {:+.1%}, too much for gains; not corrected.",
}
# Bytes for each pixel of a shot: as stored and stacked, linear, aligned or turned, written.
_WORKED = 3 * (2 + 2 + 4 + 4 + 4)


class ShotsMeasured(Measured, kw_only=True):
    """Measurements of the shots of a capture.

    Attributes:
        transfer: transfer function of the files. scale: factor of the linear values.
        rounding: rounding of codes. levels: levels of the stored values; None for those that the files state.
        light: exposures by file.
    """

    transfer: Literal["linear", "srgb"]
    scale: Factor
    rounding: StoredRounding = tuple(EXACT)
    levels: Levels | None = None
    light: dict[str, Factor]


class ShotsSource(Source):
    """Shots of an ordinary camera through a polarizing filter: what four a view and single ones have in common."""

    cameras = None
    measured_type = ShotsMeasured
    assumed: tuple[str, ...] = ()
    """Assumptions about the capture, in sentences for the user."""
    _root: Path

    def __init__(self, paths: list[Path], views: dict[str, list[Path]], settings: FilterSettings) -> None:
        """Use the shots of each view, in their order; ``paths`` are all files that are read.

        Raises:
            PolarguideError: white balance or transfer do not fit the files.
        """
        self._settings = settings
        self._of_view = views
        self.paths = paths
        self.views = sorted(views)
        self._shots = [path for view in self.views for path in views[view]]
        self._white = development_of(self._shots, settings)
        self._as_stored: frozenset[str] = frozenset()

    def stored(self, view: str) -> Stored:
        """By the header of the view's first shot."""
        first = self._of_view[view][0]
        if is_camera_raw(first):
            return Stored(*stored_frame(first))
        return Stored(stated_size(first), orientation(read_picture(first)))

    def lenses(self) -> dict[str, Lens]:
        """By the EXIF tags of each view's first shot."""
        return camera_groups({view: paths[0] for view, paths in self._of_view.items()})

    def use_stored(self, views: Collection[str]) -> None:
        """Develop these views without turning them."""
        self._as_stored = frozenset(views)

    def used_as_stored(self, view: str) -> bool:
        """Whether a view is not turned, whatever its orientation tag."""
        return view in self._as_stored

    def _require_memory(self, what: str) -> None:
        """Refuse shots of a view that do not fit into memory, by their headers alone; ``what`` is for messages.

        Raises:
            PolarguideError: the largest is too large.
        """
        require_memory_of_each(
            self._shots,
            max(map(len, self._of_view.values())) * _WORKED,
            what,
            remedy="Make all pictures smaller by the same factor.",
        )

    def _angles(self, view: str) -> Sequence[Angle]:
        """The angles of a view's pictures, as the user counts them."""
        return ANGLES

    def _decided(self, levels: Levels | None) -> TransferDecision:
        """The transfer of the capture: as given, or by a few views spread over it and what the files state."""
        several = [view for view in self.views if len(self._of_view[view]) > 1]
        views = several[:: max(1, math.ceil(len(several) / _JUDGED_VIEWS))] or self.views[:1]
        decision = transfer_of_pictures(
            self._shots,
            self._settings.transfer,
            lambda: [
                (read_stack(self._of_view[view], self._white, levels), self._angles(view)) for view in views
            ],
        )
        if decision.doubt:
            warnings.warn(decision.doubt, PolarguideWarning, stacklevel=2)
        return decision

    def _rounding(self, transfer: str, smallest: float) -> Rounding:
        """Rounding of codes: by the steps of 8-bit values, which grow with sRGB's; none for 16 bits."""
        first = self._shots[:1]
        if self._settings.precision == "full" or read_stack(first, self._white).pictures.dtype != np.uint8:
            return EXACT
        return rounding_of_bytes(transfer, smallest)

    def _name(self, path: Path) -> str:
        """A photograph's name in its folder."""
        return path.relative_to(self._root).as_posix()

    def _linear(self, view: str, measured: ShotsMeasured, *, align: bool) -> LinearShots:
        """Return the linear shots of a view; four are aligned if ``align``."""
        shots = read_stack(self._of_view[view], self._white, measured.levels)
        if self.used_as_stored(view):
            shots = replace(shots, orientation=1)
        return LinearShots.of(shots, measured.transfer, align=align)

    def _developed(
        self,
        shots: LinearShots,
        upright: NDArray[np.float32],
        invalid: NDArray[np.bool_],
        notes: Sequence[str],
        angles: Sequence[Angle] = ANGLES,
        **measurements: Any,
    ) -> DevelopedView:
        """Return the view of pictures [K, H, W, 3] that are turned for display, with its record."""
        height, width = upright.shape[1:3]
        return DevelopedView(
            intensities=np.ascontiguousarray(upright),
            invalid=np.ascontiguousarray(apply_orientation(invalid, shots.orientation)),
            record=ViewRecord(
                orientation=shots.orientation,
                clipped_share=round(shots.clipped_share, 6),
                dark_share=round(shots.dark_share, 6),
                invalid_share=round(float(invalid.mean()), 6),
                geometry=Geometry((width, height), (0, 0), 1, (width, height)),
                **measurements,
            ),
            angles=angles,
            notes=tuple(notes),
        )


class FilterSource(ShotsSource):
    """Shots of an ordinary camera through a rotating linear polarizer."""

    kind = "filter"

    def __init__(
        self, root: Path, settings: FilterSettings, shots: dict[str, dict[int, Path]] | None = None
    ) -> None:
        """Use the shots of a folder: as their names say, or as given by view and angle."""
        self._root = root
        unused = [path.name for path in list_shots(root, nested=True)[1]] if shots is None else []
        shots = find_shots(root, nested=True) if shots is None else shots
        require_four_shots(root, shots)
        unused += [path.name for files in shots.values() for a, path in files.items() if a not in ANGLES]
        if unused:
            fault = f"{root} has pictures without an angle in their names, or at other angles than 0, 45, 90 and 135"
            warnings.warn(f"{fault}, which are not used ({listed(unused)}).", PolarguideWarning, stacklevel=2)
        views = {view: [files[angle] for angle in ANGLES] for view, files in sorted(shots.items())}
        super().__init__([path for files in views.values() for path in files], views, settings)

    def measure(self, advance: Advance) -> ShotsMeasured:
        """The transfer of the capture, from a few views spread over it."""
        self._require_memory("four shots")
        settings = self._settings
        gains = settings.calibration.gains
        notes = [*self.assumed]
        levels, counted = levels_of_pictures(self._shots, self._white, self._settings)
        decision = self._decided(levels)
        notes += [*counted, decision.note]
        stated, missing = stated_exposures(self._of_view, advance) if settings.gains != "none" else ({}, "")
        notes += [missing] if missing else exposure_notes(stated)
        # One scale for all shots, with room for the largest gain that is corrected.
        room = math.sqrt(1.0 - LARGEST_IMBALANCE)
        scale = min(1.0, *gains) if gains is not None else room if settings.gains == "auto" else 1.0
        scale /= settings.calibration.peak
        smallest = scale / (max(gains) if gains is not None else 1.0 / room)
        every = [value for of_view in stated.values() for value in of_view] or [1.0]
        return ShotsMeasured(
            transfer=decision.transfer,
            scale=scale * min(1.0, *every),
            rounding=self._rounding(decision.transfer, smallest * min(1.0, *every) / max(1.0, *every)),
            levels=levels,
            light={
                self._name(path): value
                for view, values in stated.items()
                for path, value in zip(self._of_view[view], values, strict=True)
            },
            notes=notes,
        )

    def develop(self, view: str, measured: ShotsMeasured) -> DevelopedView:
        """Read the four shots: validity, transfer, shifts, exposures, gains, the sense of the angles, then the turn."""
        settings = self._settings
        shots = self._linear(view, measured, align=settings.align)
        paths = self._of_view[view]
        stated = [measured.light.get(self._name(path), 1.0) for path in paths]
        linear, exposures, warning = shots.evenly_exposed([path.name for path in paths], stated, settings)
        if warning:
            warnings.warn(f"{view}: {warning}", PolarguideWarning, stacklevel=2)
        invalid = shots.invalid
        ratio = pair_ratio(linear.mean(axis=3), ~invalid)
        gains, why = pair_gains(ratio, settings, _GAINS if settings.gains == "auto" else {})
        # A shot that the pair sums brighten beyond what its file states may exceed full scale: it counts as clipped.
        linear = linear * np.asarray(measured.scale / np.asarray(gains), np.float32)[:, None, None, None]
        invalid = invalid | (linear > 1.0).any(axis=(0, 3))
        return self._developed(
            shots,
            as_displayed(np.minimum(linear, 1.0), settings.calibration, shots.orientation),
            invalid,
            [*shift_notes(view, shots.shifts), *(f"{view}: {note}" for note in why)],
            shifts=[(shift.x, shift.y) for shift in shots.shifts],
            warps=[shift.warp for shift in shots.shifts],
            shifts_corrected=[shift.corrected for shift in shots.shifts],
            pair_ratio=ratio,
            light=[round(value, 6) for value in exposures],
            gains=list(gains),
        )


def development_of(paths: Sequence[Path], settings: FilterSettings) -> tuple[float, float, float]:
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


class SinglesSource(ShotsSource):
    """Photographs of one camera through a linear polarizer that was turned between them, or without one."""

    kind = "singles"

    def __init__(self, root: Path, settings: SinglesSettings) -> None:
        """Find the photographs and their angles.

        Raises:
            PolarguideError: one has no angle, or the settings do not fit the files.
        """
        shots, tables = find_single_shots(root, settings.angles, settings.shots_per_view or 1)
        self._root = root
        self._singles: dict[str, list[SingleShot]] = {}
        for shot in shots:
            self._singles.setdefault(shot.view, []).append(shot)
        of_view = {view: [shot.path for shot in mine] for view, mine in sorted(self._singles.items())}
        paths = [path for mine in of_view.values() for path in mine]
        super().__init__([*paths, *tables], of_view, settings)

    def measure(self, advance: Advance) -> ShotsMeasured:
        """The transfer, and what the files say about their exposure.

        Raises:
            PolarguideError: the photographs are too large, or not of one size.
        """
        self._require_memory("photographs of a view")
        stated_sizes = ((stated_size(path), path) for path in self._shots if not is_camera_raw(path))
        # Width and height may be exchanged by the side that the camera was held on.
        sizes = ((f"{max(size)}x{min(size)}", path) for size, path in stated_sizes if size is not None)
        require_one(
            self._root,
            sizes,
            "photographs of one size",
            "Export all pictures of one camera alike, without a crop.",
        )
        require_one(
            self._root,
            ((kind_of_file(path), path) for path in self._shots),
            "photographs of one kind of file",
            COMPARABLE,
        )
        levels, counted = levels_of_pictures(self._shots, self._white, self._settings)
        decision = self._decided(levels)
        stated, missing = light_of_files(self._of_view, advance)
        light = {self._name(path): value for path, value in stated.items()}
        stating = f"{'All' if light else 'None'} of {len(self._shots)} files state their exposure (EXIF)."
        return ShotsMeasured(
            transfer=decision.transfer,
            scale=1.0,
            rounding=self._rounding(decision.transfer, 1.0),
            levels=levels,
            light=light,
            notes=[*self.assumed, self._summary(), decision.note, *counted, missing or stating],
        )

    def develop(self, view: str, measured: ShotsMeasured) -> DevelopedView:
        """Read the shots of a view: validity, transfer, shifts of the usual four, the turn of pictures and angles."""
        settings = self._settings
        singles = self._singles[view]
        usual = [shot.angle for shot in singles] == list(ANGLES)
        shots = self._linear(view, measured, align=settings.align and usual)
        turn = orientation_calibration(shots.orientation)
        angles = [turned(turned(shot.angle, settings.calibration), turn) for shot in singles]
        exposures = [
            ExposureRecord(self._name(shot.path), angle, measured.light.get(self._name(shot.path)), shot.gain)
            for shot, angle in zip(singles, angles, strict=True)
        ]
        upright = np.stack([apply_orientation(picture, shots.orientation) for picture in shots.values])
        return self._developed(
            shots,
            upright,
            shots.invalid,
            shift_notes(view, shots.shifts) if usual else [],
            angles,
            exposures=exposures,
        )

    def _angles(self, view: str) -> list[Angle]:
        return [shot.angle for shot in self._singles[view]]

    def _summary(self) -> str:
        """How many photographs there are, and at which angles."""
        counts: Counter[Angle] = Counter()
        for shot in itertools.chain(*self._singles.values()):
            angle = turned(shot.angle, self._settings.calibration)
            counts[angle if isinstance(angle, str) else round(angle, 1) % 180] += 1
        unknown = counts.pop("unknown", 0)
        bare = counts.pop("none", 0)
        angles = [angle_text(angle) for angle in sorted(a for a in counts if not isinstance(a, str))]
        parts = (
            (counts.total(), f"at known angles ({listed(angles, 12)})"),
            (unknown, "at unknown angles"),
            (bare, "without a filter"),
        )
        kinds = ", ".join(f"{count} {what}" for count, what in parts if count)
        return f"{len(self._shots)} photographs of {len(self.views)} views: {kinds}."
