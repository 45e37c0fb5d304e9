"""Picture sources: photographs through a polarizing filter, four shots a view or single ones at any angles."""

from __future__ import annotations

import csv
import io
import itertools
import math
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import LARGEST_IMBALANCE, pair_ratio
from polarguide.capture.colmap.model import read_model
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
from polarguide.capture.exposures import TABLE, Angle, angle_text, turned
from polarguide.capture.filter.camera_files import (
    Lens,
    apply_orientation,
    camera_groups,
    is_camera_raw,
    orientation,
    orientation_calibration,
    stored_frame,
)
from polarguide.capture.filter.develop import shift_notes
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
from polarguide.capture.formats.pictures import decode_mask, decode_picture, read_picture, stated_size
from polarguide.capture.layout import require_memory_of_each
from polarguide.capture.point_exposures import (
    FEWEST,
    ComparedPoints,
    PointExposures,
    exposures_of_points,
    significant,
)
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES, FULL_CODE, listed
from polarguide.capture.write import EXACT, picture_names, rounding_of
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.files import write_whole
from polarguide.core.progress import Advance, Reporter
from polarguide.optics.color import srgb_decode_array
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
        raw = [path for path in self._shots if is_camera_raw(path)]
        white = white_gains(settings.white_balance)
        if white is None or (white != (1.0, 1.0, 1.0) and len(raw) < len(self._shots)):
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
        self._white = white
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

    def _rounding(self, transfer: str, smallest: float) -> tuple[tuple[int, int], ...]:
        """Rounding of codes: by the steps of 8-bit values, which grow with sRGB's; none for 16 bits."""
        first = self._shots[:1]
        if self._settings.precision == "full" or read_stack(first, self._white).pictures.dtype != np.uint8:
            return tuple(EXACT)
        levels = np.arange(256) / 255
        if transfer == "srgb":
            levels = srgb_decode_array(levels)
        return tuple(rounding_of(FULL_CODE * smallest * levels))

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
            transfer="srgb" if decision.transfer == "srgb" else "linear",
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
            transfer="srgb" if decision.transfer == "srgb" else "linear",
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


Array = NDArray[np.floating[Any]]
FILE_ERROR = 0.03
"""Relative error of exposures that files state: shutters and apertures have nominal values."""
POINTS_ERROR = 0.05
"""Relative error of exposures from points, at least: reflections move, and polarization is taken for exposure."""
LARGEST_DOUBT = 0.5
"""Logarithm of 0.7 stops: points that contradict a file by more, and by more than others do, are believed."""


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of pictures, and how well their sources agree.

    Attributes:
        logs: logarithms, [N], on an arbitrary common constant; NaN where nothing is known.
        contradicted: indices of pictures whose points contradict their file.
        scatter: robust standard deviation of the differences between points and files; None without both.
    """

    logs: Array
    contradicted: tuple[int, ...]
    scatter: float | None


def reconciled(
    points: Array, files: Array, unfiltered: NDArray[np.bool_], errors: Array | None = None
) -> Exposures:
    """Exposures from those of points and those of files.

    Small differences correct the file's value, within its usual error (``FILE_ERROR``) and the agreement of points and
    files in this capture. Large ones are taken as errors of the points, unless they exceed ``LARGEST_DOUBT``: then the
    points count. A filter takes the same share of the light from all pictures behind it, which the points tell.

    Args:
        points, files: logarithms, [N]; NaN where one is not known.
        unfiltered: [N] whether a picture was taken without a filter.
        errors: of those of points, [N]; differences that are not significant count as none.
    """
    errors = np.zeros(len(points)) if errors is None else errors
    files = files + np.where(unfiltered, np.log(2.0), 0.0)  # an ideal filter leaves half of unpolarized light
    both = np.isfinite(points) & np.isfinite(files)
    if both.sum() < 3:
        sure = np.where(significant(np.abs(points), errors), points, 0.0)
        sure = np.where(np.isfinite(points), sure, np.nan)
        aligned = sure + (np.median((files - points)[both]) if both.any() else 0.0)
        return Exposures(np.where(np.isfinite(files), files, aligned), (), None)
    shifted = files + np.median((points - files)[both])
    for group in (unfiltered, ~unfiltered):
        if (group & both).sum() >= 3:
            shifted = np.where(group, files + np.median((points - files)[group & both]), shifted)
    difference = np.where(both, points - shifted, 0.0)
    difference = np.where(significant(np.abs(difference), errors), difference, 0.0)
    scatter = 1.4826 * float(np.median(np.abs(difference[both])))
    weight = FILE_ERROR**2 / (FILE_ERROR**2 + max(scatter, POINTS_ERROR) ** 2)
    odd = both & (np.abs(difference) > max(LARGEST_DOUBT, 4 * scatter))
    correction = weight * difference / (1 + (difference / (3 * FILE_ERROR)) ** 2)
    logs = np.where(
        both, np.where(odd, points, shifted + correction), np.where(np.isfinite(points), points, shifted)
    )
    return Exposures(logs, tuple(int(k) for k in np.flatnonzero(odd)), scatter)


# Logarithm of a gain that is warned of where files do not state it: one and a half stops from the others.
_FAR = math.log(2.0) * 1.5
_LISTED = 12


@dataclass
class PictureRow:
    """A picture of the scene.

    Attributes:
        view, file: its view, and its name in ``polar/``.
        record: its record in ``scene.json``.
        points: how many points its view was compared at.
        log: logarithm of its gain.
    """

    view: str
    file: str
    record: ExposureRecord
    points: int = 0
    log: float = math.nan


def write_exposure_table(
    root: Path, views: Mapping[str, ViewRecord], gains: str, *, posed: bool, reporter: Reporter
) -> None:
    """Estimate the gain of every picture of a written scene, note it with the views, and write ``angles.csv``.

    Shots of one view share one exposure, but for what their files say. Gains that the user gave stay, and the others
    fit them; without any, the geometric mean is 1.

    Args:
        root: folder of the scene, with all views written, and the model if there is one. views: its views.
        gains: auto by the files and, with a model, by points; exif by the files alone; none for 1, or as given.
        posed: whether there is a model.
        reporter: for messages.
    """
    pictures = [
        PictureRow(view, Path(name).name, exposure)
        for view, record in sorted(views.items())
        for name, exposure in zip(
            picture_names(view, [shot.angle for shot in record.exposures or ()]),
            record.exposures or (),
            strict=True,
        )
    ]
    if gains == "none":
        for picture in pictures:
            picture.log = 0.0
    else:
        _estimate(root, pictures, posed and gains == "auto", reporter)
    stated = [math.nan if (gain := p.record.given_gain) is None else math.log(gain) for p in pictures]
    known = np.isfinite(stated)
    logs = np.array([picture.log for picture in pictures])
    shift = float(np.median((np.array(stated) - logs)[known])) if known.any() else -float(logs.mean())
    for picture, fixed, is_fixed in zip(pictures, stated, known, strict=True):
        picture.log = fixed if is_fixed else picture.log + shift
    for picture in pictures:
        picture.record.gain = float(f"{math.exp(picture.log):.6g}")
        picture.record.points = picture.points
    _tell(pictures, reporter)
    # Files are named exactly, as they are read again.
    rows = [(p.file, p.view, angle_text(p.record.angle), f"{p.record.gain:.6g}") for p in pictures]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([("file", "view", "angle", "gain"), *rows])
    write_whole(root / TABLE, text.getvalue().encode())


def _estimate(root: Path, pictures: list[PictureRow], posed: bool, reporter: Reporter) -> None:
    """Gains of all pictures, from points in common and what the files say."""
    views = list(dict.fromkeys(picture.view for picture in pictures))
    noted = [picture.record.light for picture in pictures]
    files = np.log(np.array([math.nan if light is None else light for light in noted], np.float64))
    within = _within_views(pictures, files)
    rows = {view: [k for k, picture in enumerate(pictures) if picture.view == view] for view in views}
    points = np.full(len(views), math.nan)
    numbers = np.zeros(len(views), np.int64)
    errors = np.full(len(views), math.inf)
    compared = _of_points(root, pictures, rows, within, reporter) if posed and len(views) > 1 else None
    if compared is not None:
        points = compared.logs[:, 0]
        numbers = compared.points
        errors = compared.errors
    of_view = np.array([float(np.mean((files - within)[rows[view]])) for view in views])
    # Views that were photographed both ways: whatever the shots are compared at, most of it passed the filter.
    bare = np.array([all(pictures[k].record.angle == "none" for k in rows[view]) for view in views])
    estimate = reconciled(points, of_view, bare, errors)
    lost = [view for view, log in zip(views, estimate.logs, strict=True) if not math.isfinite(log)]
    middle = float(np.nanmean(estimate.logs)) if len(lost) < len(views) else 0.0
    for place, view in enumerate(views):
        log = estimate.logs[place] if math.isfinite(estimate.logs[place]) else middle
        for k in rows[view]:
            pictures[k].log = float(log + within[k])
            pictures[k].points = int(numbers[place])
    _say_how(
        views,
        points,
        of_view,
        estimate.scatter,
        lost,
        None if compared is None else compared.significant[:, 0],
        errors,
        reporter,
    )
    _warn([views[k] for k in estimate.contradicted], pictures, of_view, reporter)


def _within_views(pictures: list[PictureRow], files: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithms of exposures relative to the mean of their view, as the files say; 0 where not all of them do."""
    relative = np.zeros(len(pictures))
    for view in {picture.view for picture in pictures}:
        places = [k for k, picture in enumerate(pictures) if picture.view == view]
        bare = np.array([pictures[k].record.angle == "none" for k in places])
        # Beside shots through the filter, one without gets twice the light at the same exposure.
        extra = np.where(bare & (not bare.all()), math.log(2.0), 0.0)
        logs = files[places] + extra if np.isfinite(files[places]).all() else extra
        relative[places] = logs - logs.mean()
    return relative


def _of_points(
    root: Path,
    pictures: list[PictureRow],
    rows: dict[str, list[int]],
    within: NDArray[np.float64],
    reporter: Reporter,
) -> PointExposures | None:
    """Exposures of views by the model's points; None where no tracks are stored."""
    model = read_model(root)
    views = list(rows)
    compared = ComparedPoints.of(model, views)
    if compared is None:
        return None
    values = np.full((len(compared.places), len(views), 1), math.nan, np.float32)
    with reporter.track("comparing exposures", len(views)) as advance:
        for column, view in enumerate(views):
            files = [root / "polar" / pictures[k].file for k in rows[view]]
            stored = [decode_picture(path, read_picture(path)) for path in files]
            path = root / "invalid" / f"{view}.png"
            samples = compared.samples(
                view, stored, decode_mask(path, read_picture(path), any_value=True), "linear"
            )
            assert samples is not None
            even = samples.values.mean(axis=2) / np.exp(within[rows[view]])
            values[compared.observed[:, column], column, 0] = even.mean(axis=1)
            advance(column + 1)
    return exposures_of_points(values, compared.places)


def _say_how(
    views: list[str],
    points: NDArray[np.float64],
    files: NDArray[np.float64],
    scatter: float | None,
    lost: list[str],
    gains: Array | None,
    errors: Array,
    reporter: Reporter,
) -> None:
    """Where the gains come from."""
    by_points = int(np.isfinite(points).sum())
    by_files = int(np.isfinite(files).sum())
    if scatter is not None:
        origin = f"Gains: exposures that the files state, and points in common ({by_points} of {len(views)} views); "
        reporter.say(f"{origin}the two differ by {scatter:.1%} (robust standard deviation).")
    elif gains is not None and by_points:
        applied = int(np.count_nonzero(np.nan_to_num(gains)))
        usual = float(np.median(errors))
        significance = f"They do not differ significantly (error {usual:.0%}): none is applied."
        if applied:
            known = int(np.isfinite(gains).sum())
            significance = (
                f"{known - applied} of {known} are not significant (error {usual:.0%}) and not applied."
            )
        reporter.say(
            f"Gains: from points in common ({by_points} of {len(views)} views); the files do not state exposures. "
            f"{significance}"
        )
    elif by_files:
        reporter.say(f"Gains: exposures that the files state ({by_files} of {len(views)} views).")
    if lost:
        reporter.warn(
            f"The gains of {len(lost)} of {len(views)} views are not known ({listed(lost)}): their files state no "
            f"exposure, and fewer than {FEWEST} points tell it. They are taken for average; {TABLE} may say better."
        )


def _warn(
    contradicted: list[str], pictures: list[PictureRow], files: NDArray[np.float64], reporter: Reporter
) -> None:
    """Name exposures that are out of the ordinary."""
    if contradicted:
        reporter.warn(
            f"{len(contradicted)} views are brighter or darker than the exposure in their files says "
            f"({listed(contradicted)}); the brightness of shared points is used instead. Was a filter taken off, "
            "or a picture edited?"
        )
    if not np.isfinite(files).any():
        logs = np.array([picture.log for picture in pictures])
        far = [p.file for p in pictures if abs(p.log - float(np.median(logs))) > _FAR]
        if far:
            reporter.warn(
                f"{len(far)} pictures are exposed by more than 1.5 stops differently ({listed(far)})."
            )


def _tell(pictures: list[PictureRow], reporter: Reporter) -> None:
    """Print the table: all pictures, or the most unusual ones of many; nothing where all gains are 1."""
    if all(picture.record.gain == 1 for picture in pictures):
        return
    listing = pictures
    if len(pictures) > _LISTED:
        listing = sorted(
            sorted(pictures, key=lambda p: -abs(p.log))[:_LISTED], key=lambda p: (p.view, p.file)
        )
    width = max(len("picture"), *(len(picture.file) for picture in listing))
    rows = [f"{'picture':<{width}}   angle    gain  stops  points"]
    for picture in listing:
        gain = picture.record.gain or 1.0
        angle = angle_text(picture.record.angle)
        stops = f"{math.log2(gain):+.2f}"
        rows.append(f"{picture.file:<{width}} {angle:>7} {gain:>7.3f} {stops:>6} {picture.points:>7}")
    if len(listing) < len(pictures):
        rows.append(f"... and {len(pictures) - len(listing)} nearer to the mean; {TABLE} has all.")
    reporter.say("\n".join(rows))
