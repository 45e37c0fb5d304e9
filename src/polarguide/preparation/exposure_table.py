"""The exposures of single shots: their gains relative to one another, and the table ``angles.csv`` of a scene."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.model import read_model
from polarguide.capture.exposures import TABLE, angle_text
from polarguide.capture.formats.pictures import decode_mask, decode_picture, read_picture
from polarguide.capture.point_exposures import (
    FEWEST,
    ComparedPoints,
    PointExposures,
    exposures_of_points,
    significant,
)
from polarguide.capture.view import listed
from polarguide.capture.write import picture_names
from polarguide.core.files import write_whole
from polarguide.core.progress import Reporter
from polarguide.preparation.journal import ExposureRecord, ViewRecord

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
class TableRow:
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
        TableRow(view, Path(name).name, exposure)
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


def _estimate(root: Path, pictures: list[TableRow], posed: bool, reporter: Reporter) -> None:
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


def _within_views(pictures: list[TableRow], files: NDArray[np.float64]) -> NDArray[np.float64]:
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
    pictures: list[TableRow],
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
    contradicted: list[str], pictures: list[TableRow], files: NDArray[np.float64], reporter: Reporter
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


def _tell(pictures: list[TableRow], reporter: Reporter) -> None:
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
        gain = picture.record.gain
        angle = angle_text(picture.record.angle)
        stops = f"{math.log2(gain):+.2f}"
        rows.append(f"{picture.file:<{width}} {angle:>7} {gain:>7.3f} {stops:>6} {picture.points:>7}")
    if len(listing) < len(pictures):
        rows.append(f"... and {len(pictures) - len(listing)} nearer to the mean; {TABLE} has all.")
    reporter.say("\n".join(rows))
