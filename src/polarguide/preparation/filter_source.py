"""Read photographs through a polarizing filter: four shots of each view, or single shots at any angles."""

from __future__ import annotations

import csv
import io
import itertools
import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.angle_evidence import TO_DEVIATION
from polarguide.capture.brackets import Bracket, MergedExposures, bracket_notes
from polarguide.capture.calibration import (
    LARGEST_IMBALANCE,
    apply_orientation,
    as_displayed,
    orientation_calibration,
    pair_ratio,
)
from polarguide.capture.colmap.model import read_model
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.develop import (
    COMPARABLE,
    BracketedShots,
    LinearShots,
    exposure_notes,
    levels_of_pictures,
    light_of_files,
    pair_gains,
    require_one,
    shift_notes,
    stated_exposures,
)
from polarguide.capture.exposures import TABLE, Angle, angle_text, turned
from polarguide.capture.filter.camera_files import (
    Lens,
    camera_groups,
    is_camera_raw,
    orientation,
    stored_frame,
)
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
from polarguide.capture.formats.pictures import decode_mask, decode_picture
from polarguide.capture.formats.stored import read_picture, stated_size
from polarguide.capture.layout import all_exposures, exposure_tables, require_memory_of_each
from polarguide.capture.point_exposures import (
    FEWEST,
    ComparedPoints,
    PointExposures,
    exposures_of_points,
    significant,
)
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES, FULL_CODE, listed
from polarguide.capture.write import EXACT, picture_names, rounding_of, suffix_of
from polarguide.core.errors import PolarguideWarning, require
from polarguide.core.files import write_whole
from polarguide.core.progress import Advance, Reporter
from polarguide.optics.color import srgb_decode_array
from polarguide.preparation.settings import FilterSettings, SinglesSettings
from polarguide.preparation.source import (
    DevelopedView,
    ExposureRecord,
    Factor,
    Measured,
    Source,
    Stored,
    StoredRounding,
    ViewRecord,
    stops_record,
)

_JUDGED_VIEWS = 8
_GAINS = {
    "dark": "The pictures are too dark to measure (I0 + I90)/(I45 + I135). Gains are not corrected.",
    "off": "(I0 + I90)/(I45 + I135) deviates from 1 by {:+.1%}, too much for gains. Gains are not corrected.",
}
# Bytes per pixel of a shot: stored, stacked, linear, aligned or rotated, written.
_WORKED = 3 * (2 + 2 + 4 + 4 + 4)


class ShotsMeasured(Measured, kw_only=True):
    """Measurements that all shots of a capture share.

    Attributes:
        transfer: transfer function of the files.
        scale: factor of the linear values.
        rounding: steps to which stored values are rounded.
        levels: black level and full scale of the stored values. None for shots whose files state them.
        light: exposures by file.
    """

    transfer: Literal["linear", "srgb"]
    scale: Factor
    rounding: StoredRounding = tuple(EXACT)
    levels: Levels | None = None
    light: dict[str, Factor]


class ShotsSource(Source):
    """Base class for sources of shots that an ordinary camera took through a polarizing filter."""

    cameras = None
    measured_type = ShotsMeasured
    assumed: tuple[str, ...] = ()
    """Sentences for the user that list the assumptions about the capture."""
    _root: Path

    def __init__(self, paths: list[Path], views: dict[str, list[Path]], settings: FilterSettings) -> None:
        """Use the shots of each view in their order.

        Args:
            paths: all files that are read.
            views: shots by view.
            settings: settings of the preparation.

        Raises:
            PolarguideError: the transfer function does not fit the files.
        """
        self._settings = settings
        self._of_view = views
        self.paths = paths
        self.views = sorted(views)
        self._shots = [path for view in self.views for path in views[view]]
        require(
            settings.transfer != "srgb" or not any(map(is_camera_raw, self._shots)),
            "--transfer",
            expected="auto or linear for camera raw, which is developed without tone curve",
            found="srgb",
            remedy="Remove the option.",
        )

    def stored(self, view: str) -> Stored:
        """Return size and orientation of a view, from the header of its first shot."""
        first = self._of_view[view][0]
        if is_camera_raw(first):
            return Stored(*stored_frame(first))
        return Stored(stated_size(first), orientation(read_picture(first)))

    def lenses(self) -> dict[str, Lens]:
        """Return the lens of each view, from the EXIF tags of its first shot."""
        return camera_groups({view: paths[0] for view, paths in self._of_view.items()})

    def _require_memory(self, what: str) -> None:
        """Check that the shots of the largest view fit into memory. Only headers are read.

        ``what`` is the name of the shots in messages.

        Raises:
            PolarguideError: the largest view is too large.
        """
        require_memory_of_each(
            self._shots,
            max(map(len, map(all_exposures, self._of_view.values()))) * _WORKED,
            what,
            remedy="Make all pictures smaller by the same factor.",
        )

    def _angles(self, view: str) -> Sequence[Angle]:
        """Return the angles of the pictures of a view, as files or settings state them."""
        return ANGLES

    def _decide_transfer(self, levels: Levels | None) -> TransferDecision:
        """Return the transfer function that the settings specify.

        Otherwise, estimate it from the files and from a few views that are spread over the capture.
        """
        several = [view for view in self.views if len(self._of_view[view]) > 1]
        views = several[:: max(1, math.ceil(len(several) / _JUDGED_VIEWS))] or self.views[:1]
        decision = transfer_of_pictures(
            self._shots,
            self._settings.transfer,
            lambda: [(read_stack(self._of_view[view], levels), self._angles(view)) for view in views],
        )
        if decision.doubt:
            warnings.warn(decision.doubt, PolarguideWarning, stacklevel=2)
        return decision

    def _rounding(self, transfer: str, smallest: float) -> tuple[tuple[int, int], ...]:
        """Return the steps to which stored values are rounded.

        8-bit values have steps that grow with the brightness if they are encoded in sRGB. 16-bit values are not
        rounded.
        """
        first = self._shots[:1]
        if self._settings.precision == "full" or read_stack(first).pictures.dtype != np.uint8:
            return tuple(EXACT)
        levels = np.arange(256) / 255
        if transfer == "srgb":
            levels = srgb_decode_array(levels)
        return tuple(rounding_of(FULL_CODE * smallest * levels))

    def _name(self, path: Path) -> str:
        """Return the path of a photograph relative to the folder of the capture."""
        return path.relative_to(self._root).as_posix()

    def _merged(self, view: str, levels: Levels | None, transfer: str, *, align: bool) -> LinearShots:
        """Return the linear shots of a view. They are aligned if ``align`` is True."""
        read = BracketedShots.read(self._of_view[view], levels)
        if view in self.as_stored:
            read = replace(read, shots=[replace(shots, orientation=1) for shots in read.shots])
        return LinearShots.of(read, transfer, align=align)

    def _merged_exposures(self, levels: Levels | None, transfer: str) -> list[MergedExposures]:
        """Merge the exposures of each view that has several ones, so that faults are found before any work is done.

        Raises:
            PolarguideError: the exposures of a view contradict each other.
        """
        several = [view for view in self.views if not Bracket.of(self._of_view[view]).single]
        return [self._merged(view, levels, transfer, align=False).exposures for view in several]

    def _view(
        self,
        shots: LinearShots,
        upright: NDArray[np.float32],
        invalid: NDArray[np.bool_],
        notes: Sequence[str],
        angles: Sequence[Angle] = ANGLES,
        **measurements: Any,
    ) -> DevelopedView:
        """Return a developed view from pictures [K, H, W, 3] in display orientation, including its record."""
        height, width = upright.shape[1:3]
        return DevelopedView(
            intensities=np.ascontiguousarray(upright),
            invalid=np.ascontiguousarray(apply_orientation(invalid, shots.orientation)),
            record=ViewRecord(
                orientation=shots.orientation,
                clipped_share=round(shots.clipped_share, 6),
                dark_share=round(shots.dark_share, 6),
                invalid_share=round(float(invalid.mean()), 6),
                stops=stops_record(shots.exposures),
                geometry=Geometry((width, height), (0, 0), 1, (width, height)),
                **measurements,
            ),
            angles=angles,
            notes=tuple(notes),
        )


class FilterSource(ShotsSource):
    """Source of views with four shots each, taken through a rotating linear polarizer."""

    kind = "filter"

    def __init__(
        self, root: Path, settings: FilterSettings, shots: dict[str, dict[int, Path]] | None = None
    ) -> None:
        """Find the shots of a folder by their names, unless ``shots`` specifies them by view and angle."""
        self._root = root
        unused = [path.name for path in list_shots(root, nested=True)[1]] if shots is None else []
        shots = find_shots(root, nested=True) if shots is None else shots
        require_four_shots(root, shots)
        unused += [path.name for files in shots.values() for a, path in files.items() if a not in ANGLES]
        if unused:
            fault = f"{root} contains pictures without an angle in their names, or at other angles than 0, 45, 90, 135"
            warnings.warn(f"{fault}. They are not used ({listed(unused)}).", PolarguideWarning, stacklevel=2)
        views = {view: [files[angle] for angle in ANGLES] for view, files in sorted(shots.items())}
        files = [path for paths in views.values() for path in paths]
        super().__init__([*all_exposures(files), *exposure_tables(files)], views, settings)

    @property
    def description(self) -> str:
        """Number of views and of shots."""
        return f"{len(self.views)} views, each with shots at 0, 45, 90 and 135 degrees ({len(self._shots)} pictures)"

    def measure(self, advance: Advance) -> ShotsMeasured:
        """Measure the levels, the transfer function and the exposures of the capture."""
        self._require_memory("four shots")
        settings = self._settings
        gains = settings.calibration.gains
        levels, level_notes = levels_of_pictures(all_exposures(self._shots), self._settings)
        decision = self._decide_transfer(levels)
        stated, missing = stated_exposures(self._of_view, advance) if settings.gains != "none" else ({}, "")
        # One scale for all shots, with headroom for the largest gain that is corrected.
        headroom = math.sqrt(1.0 - LARGEST_IMBALANCE)
        scale = min(1.0, *gains) if gains is not None else headroom if settings.gains == "auto" else 1.0
        scale /= settings.calibration.peak
        smallest = scale / (max(gains) if gains is not None else 1.0 / headroom)
        every = [value for values in stated.values() for value in values] or [1.0]
        merged = self._merged_exposures(levels, decision.transfer)
        return ShotsMeasured(
            bracketed=bool(merged),
            transfer="srgb" if decision.transfer == "srgb" else "linear",
            scale=scale * min(1.0, *every),
            rounding=self._rounding(decision.transfer, smallest * min(1.0, *every) / max(1.0, *every)),
            levels=levels,
            light={
                self._name(path): value
                for view, values in stated.items()
                for path, value in zip(self._of_view[view], values, strict=True)
            },
            notes=[
                *self.assumed,
                *level_notes,
                decision.note,
                *([missing] if missing else exposure_notes(stated)),
                *bracket_notes(merged),
            ],
        )

    def develop(self, view: str, measured: ShotsMeasured) -> DevelopedView:
        """Develop the four shots of a view.

        The steps are: find invalid pixels, linearize, align, correct exposures and gains, correct the sense of the
        angles, rotate for display.
        """
        settings = self._settings
        shots = self._merged(view, measured.levels, measured.transfer, align=settings.align)
        paths = self._of_view[view]
        stated = [measured.light.get(self._name(path), 1.0) for path in paths]
        linear, exposures, warning = shots.evenly_exposed([path.name for path in paths], stated, settings)
        if warning:
            warnings.warn(f"{view}: {warning}", PolarguideWarning, stacklevel=2)
        invalid = shots.invalid
        ratio = pair_ratio(linear.mean(axis=3), ~invalid)
        gains, notes = pair_gains(ratio, settings, _GAINS if settings.gains == "auto" else {})
        linear = linear * np.asarray(measured.scale / np.asarray(gains), np.float32)[:, None, None, None]
        if not measured.bracketed:
            # Measured gains can exceed the stated ones. Values above full scale then count as clipped.
            invalid = invalid | (linear > 1.0).any(axis=(0, 3))
            linear = np.minimum(linear, 1.0)
        return self._view(
            shots,
            as_displayed(linear, settings.calibration, shots.orientation),
            invalid,
            [*shift_notes(view, shots.shifts), *(f"{view}: {note}" for note in notes)],
            shifts=[(shift.x, shift.y) for shift in shots.shifts],
            warps=[shift.warp for shift in shots.shifts],
            shifts_corrected=[shift.corrected for shift in shots.shifts],
            pair_ratio=ratio,
            light=[round(value, 6) for value in exposures],
            gains=list(gains),
        )


class SinglesSource(ShotsSource):
    """Source of photographs through a linear polarizer at any angles, or without one."""

    kind = "singles"

    def __init__(self, root: Path, settings: SinglesSettings) -> None:
        """Find the photographs and their angles.

        Raises:
            PolarguideError: a photograph has no angle, or the settings do not fit the files.
        """
        shots, tables = find_single_shots(root, settings.angles, settings.shots_per_view or 1)
        self._root = root
        self._singles: dict[str, list[SingleShot]] = {}
        for shot in shots:
            self._singles.setdefault(shot.view, []).append(shot)
        files = {view: [shot.path for shot in group] for view, group in sorted(self._singles.items())}
        paths = [shot.path for shot in shots]
        super().__init__([*all_exposures(paths), *exposure_tables(paths), *tables], files, settings)

    @property
    def description(self) -> str:
        """Number of photographs and their angles."""
        angles = {shot.angle for shots in self._singles.values() for shot in shots}
        if angles == {"none"}:
            return f"{len(self._shots)} photographs without a polarizing filter"
        texts = sorted(map(angle_text, angles), key=lambda text: (len(text), text))
        return (
            f"{len(self.views)} views, {len(self._shots)} photographs through a polarizing filter "
            f"(angles: {listed(texts)})"
        )

    def measure(self, advance: Advance) -> ShotsMeasured:
        """Measure the levels and the transfer function of the capture, and read the exposures that files state.

        Raises:
            PolarguideError: the photographs are too large, or have different sizes.
        """
        self._require_memory("photographs of a view")
        stated_sizes = ((stated_size(path), path) for path in self._shots if not is_camera_raw(path))
        # Portrait and landscape pictures exchange width and height.
        sizes = ((f"{max(size)}x{min(size)}", path) for size, path in stated_sizes if size is not None)
        require_one(
            self._root,
            sizes,
            "photographs of one size",
            "Export all pictures of one camera with the same settings, without a crop.",
        )
        require_one(
            self._root,
            ((kind_of_file(path), path) for path in self._shots),
            "photographs of one kind of file",
            COMPARABLE,
        )
        levels, level_notes = levels_of_pictures(all_exposures(self._shots), self._settings)
        decision = self._decide_transfer(levels)
        stated, missing = light_of_files(self._of_view, advance)
        light = {self._name(path): value for path, value in stated.items()}
        stating = f"{'All' if light else 'None'} of {len(self._shots)} files state their exposure (EXIF)."
        merged = self._merged_exposures(levels, decision.transfer)
        return ShotsMeasured(
            bracketed=bool(merged),
            transfer="srgb" if decision.transfer == "srgb" else "linear",
            scale=1.0,
            rounding=self._rounding(decision.transfer, 1.0),
            levels=levels,
            light=light,
            notes=[
                *self.assumed,
                self._summary(),
                decision.note,
                *level_notes,
                missing or stating,
                *bracket_notes(merged),
            ],
        )

    def develop(self, view: str, measured: ShotsMeasured) -> DevelopedView:
        """Develop the shots of a view.

        The steps are: find invalid pixels, linearize, align shots at the usual four angles, rotate for display.
        """
        settings = self._settings
        singles = self._singles[view]
        usual = [shot.angle for shot in singles] == list(ANGLES)
        shots = self._merged(view, measured.levels, measured.transfer, align=settings.align and usual)
        turn = orientation_calibration(shots.orientation)
        angles = [turned(turned(shot.angle, settings.calibration), turn) for shot in singles]
        exposures = [
            ExposureRecord(self._name(shot.path), angle, measured.light.get(self._name(shot.path)), shot.gain)
            for shot, angle in zip(singles, angles, strict=True)
        ]
        upright = np.stack([apply_orientation(picture, shots.orientation) for picture in shots.values])
        return self._view(
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
        """Return a sentence for the user with the number of photographs and their angles."""
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
        kinds = ", ".join(f"{count} {kind}" for count, kind in parts if count)
        return f"{len(self._shots)} photographs of {len(self.views)} views: {kinds}."


Array = NDArray[np.floating[Any]]
FILE_ERROR = 0.03
"""Relative error of exposures that files state. Shutters and apertures deviate from their nominal values."""
POINTS_ERROR = 0.05
"""Smallest relative error of exposures that are estimated from points.

Moving reflections and polarization change the brightness of a point like an exposure does.
"""
LARGEST_DOUBT = 0.5
"""Largest difference between the logarithms of two exposures of a picture that counts as an error of the points.

It corresponds to 0.7 stops. If the exposure from points differs by more, and by more than in the remaining pictures, it
replaces the exposure that the file states.
"""


@dataclass(frozen=True, eq=False)
class Exposures:
    """Combined exposures of pictures, and the agreement between exposures from points and from files.

    Attributes:
        logs: logarithms [N] up to a common constant; NaN if unknown.
        contradicted: indices of pictures whose points contradict the exposure that their file states.
        scatter: robust standard deviation of the differences between points and files. None if one of them is missing.
    """

    logs: Array
    contradicted: tuple[int, ...]
    scatter: float | None


def reconciled(
    points: Array, files: Array, unfiltered: NDArray[np.bool_], errors: Array | None = None
) -> Exposures:
    """Combine exposures that are estimated from points with exposures that files state.

    Small differences correct the file's value, within its usual error (``FILE_ERROR``) and the agreement of points and
    files in this capture. Larger differences count as errors of the points. If a difference exceeds ``LARGEST_DOUBT``,
    the value from points is used instead. The filter absorbs the same share of light in all pictures; this share is
    estimated from the points.

    Args:
        points: logarithms [N] of exposures from points; NaN if unknown.
        files: logarithms [N] of exposures from files; NaN if unknown.
        unfiltered: mask [N] of pictures without a filter.
        errors: standard errors of ``points``, [N]. Differences within these errors count as 0.
    """
    errors = np.zeros(len(points)) if errors is None else errors
    files = files + np.where(
        unfiltered, np.log(2.0), 0.0
    )  # an ideal filter transmits half of unpolarized light
    both = np.isfinite(points) & np.isfinite(files)
    if both.sum() < 3:
        certain = np.where(significant(np.abs(points), errors), points, 0.0)
        certain = np.where(np.isfinite(points), certain, np.nan)
        aligned = certain + (np.median((files - points)[both]) if both.any() else 0.0)
        return Exposures(np.where(np.isfinite(files), files, aligned), (), None)
    shifted = files + np.median((points - files)[both])
    for group in (unfiltered, ~unfiltered):
        if (group & both).sum() >= 3:
            shifted = np.where(group, files + np.median((points - files)[group & both]), shifted)
    difference = np.where(both, points - shifted, 0.0)
    difference = np.where(significant(np.abs(difference), errors), difference, 0.0)
    scatter = TO_DEVIATION * float(np.median(np.abs(difference[both])))
    weight = FILE_ERROR**2 / (FILE_ERROR**2 + max(scatter, POINTS_ERROR) ** 2)
    odd = both & (np.abs(difference) > max(LARGEST_DOUBT, 4 * scatter))
    correction = weight * difference / (1 + (difference / (3 * FILE_ERROR)) ** 2)
    logs = np.where(
        both, np.where(odd, points, shifted + correction), np.where(np.isfinite(points), points, shifted)
    )
    return Exposures(logs, tuple(int(k) for k in np.flatnonzero(odd)), scatter)


# Smallest unusual deviation of a gain's logarithm (1.5 stops). A warning follows unless a file states this gain.
_FAR = math.log(2.0) * 1.5


@dataclass
class PictureRow:
    """One picture of the scene, and the quantities that determine its gain.

    Attributes:
        view: name of its view.
        file: name of its file in ``polar/``.
        record: its record in ``scene.json``.
        points: number of points at which its view was compared with other views.
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
    """Estimate the gains of all pictures of a written scene, add them to the records, and write ``angles.csv``.

    Shots of one view have the same exposure unless their files state different exposures. If the user stated gains,
    they are kept, and the estimated gains are scaled to fit them. Otherwise, the gains have the geometric mean 1.

    Args:
        root: folder of the scene with all views, and with the COLMAP model if it exists.
        views: records of the views, by name.
        gains: "auto" uses files and, if there is a model, points. "exif" uses files only. "none" sets all gains to 1,
            or keeps gains that the user stated.
        posed: True if the scene has a model.
        reporter: receiver of messages.
    """
    pictures = [
        PictureRow(view, Path(name).name, exposure)
        for view, record in sorted(views.items())
        for name, exposure in zip(
            picture_names(view, [shot.angle for shot in record.exposures or ()], suffix_of(record.files)),
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
    # Names are not escaped, because the table is read again.
    rows = [(p.file, p.view, angle_text(p.record.angle), f"{p.record.gain:.6g}") for p in pictures]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([("file", "view", "angle", "gain"), *rows])
    write_whole(root / TABLE, text.getvalue().encode())


def _estimate(root: Path, pictures: list[PictureRow], posed: bool, reporter: Reporter) -> None:
    """Estimate the gains of all pictures from shared points and stated exposures."""
    views = list(dict.fromkeys(picture.view for picture in pictures))
    stated = [picture.record.light for picture in pictures]
    files = np.log(np.array([math.nan if light is None else light for light in stated], np.float64))
    within = _within_views(pictures, files)
    rows = {view: [k for k, picture in enumerate(pictures) if picture.view == view] for view in views}
    points = np.full(len(views), math.nan)
    numbers = np.zeros(len(views), np.int64)
    errors = np.full(len(views), math.inf)
    compared = _compare_points(root, pictures, rows, within, reporter) if posed and len(views) > 1 else None
    if compared is not None:
        points = compared.logs[:, 0]
        numbers = compared.points
        errors = compared.errors
    of_view = np.array([float(np.mean((files - within)[rows[view]])) for view in views])
    # A view that has shots with and without a filter counts as a view with a filter.
    bare = np.array([all(pictures[k].record.angle == "none" for k in rows[view]) for view in views])
    estimate = reconciled(points, of_view, bare, errors)
    finite = np.isfinite(estimate.logs)
    logs = np.where(finite, estimate.logs, np.nanmean(estimate.logs) if finite.any() else 0.0)
    for place, view in enumerate(views):
        for k in rows[view]:
            pictures[k].log = float(logs[place] + within[k])
            pictures[k].points = int(numbers[place])
    unknown = [view for view, is_finite in zip(views, finite, strict=True) if not is_finite]
    _say_origin(of_view, estimate.scatter, compared, unknown, reporter)
    _warn([views[k] for k in estimate.contradicted], pictures, of_view, reporter)


def _within_views(pictures: list[PictureRow], files: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of each picture's stated exposure relative to the mean of its view.

    Return 0 for pictures whose files state no exposure.
    """
    relative = np.zeros(len(pictures))
    for view in {picture.view for picture in pictures}:
        places = [k for k, picture in enumerate(pictures) if picture.view == view]
        bare = np.array([pictures[k].record.angle == "none" for k in places])
        # At the same exposure, a shot without the filter gets twice the light of a shot through the filter.
        extra = np.where(bare & (not bare.all()), math.log(2.0), 0.0)
        logs = files[places] + extra if np.isfinite(files[places]).all() else extra
        relative[places] = logs - logs.mean()
    return relative


def _compare_points(
    root: Path,
    pictures: list[PictureRow],
    rows: dict[str, list[int]],
    within: NDArray[np.float64],
    reporter: Reporter,
) -> PointExposures | None:
    """Estimate exposures of views from the points of the model. Return None if the model has no tracks."""
    model = read_model(root)
    views = list(rows)
    compared = ComparedPoints.of(model, views)
    if compared is None:
        return None
    values = np.full((len(compared.places), len(views), 1), math.nan, np.float32)
    with reporter.track("comparing exposures", len(views)) as advance:
        for column, view in enumerate(views):
            files = [root / "polar" / pictures[k].file for k in rows[view]]
            stored = [decode_picture(path, read_picture(path), keep_floats=True) for path in files]
            path = root / "invalid" / f"{view}.png"
            samples = compared.samples(
                view, stored, decode_mask(path, read_picture(path), any_value=True), "linear"
            )
            assert samples is not None
            even = samples.values.mean(axis=2) / np.exp(within[rows[view]])
            values[compared.observed[:, column], column, 0] = even.mean(axis=1)
            advance(column + 1)
    return exposures_of_points(values, compared.places)


def _say_origin(
    files: NDArray[np.float64],
    scatter: float | None,
    compared: PointExposures | None,
    unknown: list[str],
    reporter: Reporter,
) -> None:
    """Print how the gains were determined.

    Args:
        files: logarithms [V] of the exposures that the files of each view state; NaN if they state none.
        scatter: standard deviation of the differences between points and files, or None.
        compared: exposures from points, or None.
        unknown: views without a known exposure.
        reporter: receiver of messages.
    """
    count = len(files)
    by_points = 0 if compared is None else int(np.isfinite(compared.logs[:, 0]).sum())
    by_files = int(np.isfinite(files).sum())
    if scatter is not None:
        reporter.say(
            f"Gains: exposures that the files state, and shared points ({by_points} of {count} views). The two differ "
            f"by {scatter:.1%} (robust standard deviation)."
        )
    elif compared is not None and by_points:
        applied = int(np.count_nonzero(np.nan_to_num(compared.significant[:, 0])))
        reporter.say(
            f"Gains: from shared points ({by_points} of {count} views). The files do not state exposures. {applied} "
            f"gains are significant and applied (error {float(np.median(compared.errors)):.0%})."
        )
    elif by_files:
        reporter.say(f"Gains: exposures that the files state ({by_files} of {count} views).")
    if unknown:
        reporter.warn(
            f"The gains of {len(unknown)} of {count} views are unknown ({listed(unknown)}): their files state no "
            f"exposure, and they have fewer than {FEWEST} points. The mean is assumed; {TABLE} can state their gains."
        )


def _warn(
    contradicted: list[str], pictures: list[PictureRow], files: NDArray[np.float64], reporter: Reporter
) -> None:
    """Warn about unusual exposures, and about files whose exposures contradict the points."""
    if contradicted:
        reporter.warn(
            f"The brightness of shared points in {len(contradicted)} views contradicts the exposure in their files "
            f"({listed(contradicted)}) and is used instead. Was a filter removed, or a picture edited?"
        )
    if not np.isfinite(files).any():
        logs = np.array([picture.log for picture in pictures])
        far = [p.file for p in pictures if abs(p.log - float(np.median(logs))) > _FAR]
        if far:
            reporter.warn(
                f"The exposures of {len(far)} pictures differ from the others by more than 1.5 stops ({listed(far)})."
            )
