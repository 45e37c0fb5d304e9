"""Find sets of pictures at any polarizer angles: by names, folders, a table, or frames of a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.exposures import (
    FEWEST,
    LARGEST,
    TABLE,
    WELL_CONDITIONED,
    Angle,
    Exposure,
    Line,
    angle_text,
    angles_of_names,
    conditioning,
    covers_turn,
    folders_of_angles,
    nominal,
    normalized,
    parse_angle,
)
from polarguide.capture.filter.consecutive import VIDEO_SUFFIXES
from polarguide.capture.filter.shots import (
    SHOT_SUFFIXES,
    angle_order,
    group_files,
    listed_pictures,
    views_of_names,
)
from polarguide.capture.layout import ambiguous, list_files
from polarguide.capture.view import ANGLES, listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_rows, require_file
from polarguide.core.records import shortened
from polarguide.core.text import canonical, stem_of, whole_number
from polarguide_shots.options import Kind


@dataclass(frozen=True)
class SetPicture:
    """One picture of a set.

    Attributes:
        path: path of the picture, or of the video.
        angle: of the polarizer as the user counts it, degrees; "unknown", or "none" without a polarizer: not used.
        gain: exposure relative to the others, where a table states it.
        frame: frame of the video, from 0; None for a picture file.
    """

    path: Path
    angle: Angle
    gain: float | None = None
    frame: int | None = None

    @property
    def label(self) -> str:
        """Its name in messages."""
        return self.path.name if self.frame is None else f"{self.path.name} frame {self.frame}"


@dataclass(frozen=True)
class ExposureSet:
    """The files of one shot.

    Attributes:
        name: unique among the sets that were found together; usable in a file name.
        kind: mosaic (one file), filter (one file at 0, 45, 90 and 135 degrees each), set (pictures at any angles) or
            scene (a view of a scene folder).
        files: by angle; a mosaic's under 0, none of a set. Angles may be missing: ``read_shot`` says so.
        root: folder of the scene; else None.
        view: its name in the scene.
        fault: why it is no shot: ``read_shot`` raises it, and the shots beside it are not concerned.
        others: where there is a fault, files that ``files`` has no place for; or the folder that it is in. Of a view of
            a scene, its pictures where they are not the usual four.
        pictures: pictures of a set, by angle.
        table: that states their angles; None where names do.
        stored: the pictures of a shot in memory, which has no files: [H, W] of a mosaic, else [K, H, W, 3].
        angles: theirs, as the user counts them; none of a mosaic.
    """

    name: str
    kind: Kind
    files: dict[int, Path]
    root: Path | None = None
    view: str = ""
    fault: PolarguideError | None = None
    others: tuple[Path, ...] = ()
    pictures: tuple[SetPicture, ...] = ()
    table: Path | None = None
    stored: NDArray[Any] | None = None
    angles: tuple[Angle, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files, by angle, and the table of a set; at least one, or none of a shot in memory."""
        of_set = dict.fromkeys(picture.path for picture in self.pictures)
        more = [] if self.table is None else [self.table]
        return (*(path for _, path in sorted(self.files.items())), *of_set, *more, *self.others)

    @property
    def where(self) -> Path | str:
        """Its name in messages: its first file, or its name."""
        return self.paths[0] if self.paths else self.name

    @property
    def whole(self) -> bool:
        """Whether no more pictures of a set are expected: a table lists them, or they cover half a turn evenly."""
        angles = [picture.angle for picture in self.pictures if not isinstance(picture.angle, str)]
        return self.table is not None or covers_turn([angle % 180 for angle in angles])

    @property
    def nothing(self) -> bool:
        """Whether there is no shot, but only a fault."""
        return self.fault is not None and not (self.files or self.pictures)


def require_determined(where: object, angles: Sequence[Angle]) -> None:
    """Refuse angles that do not determine a Stokes vector, or hardly.

    Raises:
        PolarguideError: fewer than three known angles differ modulo 180 degrees, or all are too much alike.
    """
    words = listed([angle_text(angle) for angle in angles], 12)
    exposures = [Exposure(normalized(angle)) for angle in angles if not isinstance(angle, str)]
    different = len({round(e.angle or 0.0, 6) % 180 for e in exposures})
    if different < FEWEST:
        raise PolarguideError(
            where,
            expected="pictures at three or more different angles (modulo 180 degrees)",
            found=f"{different} ({words})",
            remedy="Add pictures: 0, 60 and 120 degrees are enough.",
        )
    condition = conditioning(nominal(exposures))
    if condition < WELL_CONDITIONED:
        raise PolarguideError(
            where,
            expected=f"angles spread over half a turn, with a conditioning of {WELL_CONDITIONED:g} or more",
            found=f"{condition:.2g} ({words})",
            remedy="Turn the polarizer further: 0, 60 and 120 degrees have 0.71.",
        )


def known_places(view: str, exposures: Sequence[Exposure]) -> list[int]:
    """The places of the pictures of a view at known angles.

    Raises:
        PolarguideError: the angles do not determine Stokes vectors.
    """
    angles: list[Angle] = [
        e.angle if e.angle is not None else "unknown" if e.filtered else "none" for e in exposures
    ]
    require_determined(f"view {view}", angles)
    return [place for place, angle in enumerate(angles) if not isinstance(angle, str)]


def _exposure_set(
    name: str,
    pictures: Iterable[SetPicture],
    table: Path | None = None,
    fault: PolarguideError | None = None,
) -> ExposureSet:
    """A set with its pictures in order, and its fault if its angles determine nothing.

    One picture each at 0, 45, 90 and 135 degrees, without gains, are a shot of four.
    """
    mine = tuple(sorted(pictures, key=lambda p: (*angle_order(p.angle), p.path.name, p.frame or 0)))
    if fault is None:
        try:
            require_determined(f"{(table or mine[0].path.parent)} ({name})", [p.angle for p in mine])
        except PolarguideError as error:
            fault = error
    four = {int(p.angle): p.path for p in mine if p.angle in ANGLES and p.gain is None and p.frame is None}
    if fault is None and len(four) == len(mine) == len(ANGLES):
        return ExposureSet(name, "filter", four, table=table)
    return ExposureSet(name, "set", {}, fault=fault, pictures=mine, table=table)


def by_name(files: Sequence[Path]) -> tuple[list[ExposureSet], list[Path]]:
    """Sets by the names of files, and the files that belong to no set: of four angles at most, or without an angle.

    Files named like angles alone are one set, called like their folder, where there is nothing else among the files.
    """
    sets: list[ExposureSet] = []
    rest: list[Path] = []
    for folder in dict.fromkeys(path.parent for path in files):
        inside = [path for path in files if path.parent == folder]
        views: dict[str, list[SetPicture]] = {}
        for path, name in zip(inside, views_of_names(folder, inside), strict=True):
            if name is None:
                rest.append(path)
            else:
                views.setdefault(name[0], []).append(SetPicture(path, name[1]))
        for view, mine in sorted(views.items()):
            paths = [picture.path for picture in mine]
            four = all(picture.angle in ANGLES for picture in mine)
            # Names with a mark such as cup_a45 are known here alone.
            if four and not (len(mine) == 4 and group_files(paths)[1]):
                rest += paths
            else:
                sets.append(_named_set(folder, view, mine))
    return sets, rest


def by_folder(root: Path) -> list[ExposureSet]:
    """Sets by folders named like angles, a file of each view in each; nothing where these are four at most."""
    views: dict[str, list[SetPicture]] = {}
    for folder, angle in folders_of_angles(root).items():
        for path in list_files(folder, SHOT_SUFFIXES):
            views.setdefault(stem_of(path), []).append(SetPicture(path, angle))
    if all(picture.angle in ANGLES for mine in views.values() for picture in mine):
        return []
    return [_named_set(root, view, mine) for view, mine in sorted(views.items())]


def _named_set(folder: Path, view: str, pictures: Sequence[SetPicture]) -> ExposureSet:
    """A set by names: two files that state the same number are one picture too many."""
    first: dict[Angle, Path] = {}
    for picture in pictures:
        earlier = first.setdefault(picture.angle, picture.path)
        if earlier is not picture.path:
            expected = f"one picture of {view} at {angle_text(picture.angle)} degrees"
            return _exposure_set(view, pictures, fault=ambiguous(folder, expected, earlier, picture.path))
    return _exposure_set(view, pictures)


def by_table(root: Path) -> tuple[list[ExposureSet], list[Path]]:
    """Sets that the table ``angles.csv`` of a folder lists, and the pictures of the folder that it does not list.

    Lines with one view are a set. Lines without a view are sets by the names of their files where all of these state a
    view, else one set called like the folder. Doubles are taken as they are.

    Raises:
        PolarguideError: the table cannot be read, or names files outside of the folder or of other kinds.
    """
    table = root / TABLE
    rows, others = listed_pictures(root, table)
    lines = [line for line, _ in rows]
    views: dict[str, list[SetPicture]] = {}
    for (line, path), view in zip(rows, _views_of(root, lines), strict=True):
        views.setdefault(view, []).append(SetPicture(path, line.angle, line.gain))
    return [_of_table(table, view, mine) for view, mine in sorted(views.items())], others


def _views_of(root: Path, lines: Sequence[Line]) -> list[str]:
    """The view of each line."""
    without = [line for line in lines if line.view is None]
    named = angles_of_names([stem_of(Path(line.file)) for line in without])
    all_named = all(name is not None and name[0] for name in named)
    of_file = {
        line.file: name[0] if all_named and name is not None else canonical(root.resolve().name)
        for line, name in zip(without, named, strict=True)
    }
    return [of_file[line.file] if line.view is None else line.view for line in lines]


def _of_table(table: Path, view: str, pictures: Sequence[SetPicture]) -> ExposureSet:
    """Return the set of a view's pictures; a missing file is its fault."""
    there = [picture for picture in pictures if picture.path.is_file()]
    missing = next((picture.path for picture in pictures if not picture.path.is_file()), None)
    if missing is None:
        return _exposure_set(view, there, table)
    fault = PolarguideError(
        table,
        expected=f"the file {missing}",
        found="nothing of this name",
        remedy="Correct the file's name in the table, or remove its line.",
    )
    return _exposure_set(view, there, table, fault)


def videos(files: Sequence[Path]) -> list[ExposureSet]:
    """Each video as a set, with the frames that the table beside it lists."""
    sets = []
    for path in files:
        if path.suffix.lower() not in VIDEO_SUFFIXES:
            continue
        table = path.with_suffix(".csv")
        try:
            frames = read_frame_table(table, path)
        except PolarguideError as error:
            sets.append(_exposure_set(stem_of(path), [SetPicture(path, "unknown")], None, error))
        else:
            pictures = [SetPicture(path, angle, None, frame) for frame, angle in frames]
            sets.append(_exposure_set(stem_of(path), pictures, table))
    return sets


_COLUMNS = ["frame", "angle"]
_REMEDY = "Write a line for each frame to use: its number, counted from 0, and its angle in degrees."


def read_frame_table(path: Path, video: Path) -> list[tuple[int, Angle]]:
    """The lines of a table ``frame,angle``: frames counted from 0, and their angles.

    Raises:
        PolarguideError: there is no such table, a cell is wrong, or a frame is listed twice.
    """
    if not path.is_file():
        raise PolarguideError(
            path, expected=f"a table frame,angle of {video.name}", found="no such file", remedy=_REMEDY
        )
    rows = read_rows(path, _REMEDY)
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    if header != _COLUMNS:
        found = shortened(",".join(header)) or "an empty file"
        raise PolarguideError(
            f"{path} (line 1)", expected="the header frame,angle", found=found, remedy=_REMEDY
        )
    frames: dict[int, Angle] = {}
    for number, row in rows[1:]:
        angle = parse_angle(row[1]) if len(row) == len(_COLUMNS) else None
        frame = whole_number(row[0])
        if angle is None or frame is None or frame in frames:
            raise PolarguideError(
                f"{path} (line {number})",
                expected=f"a frame that no other line has, and its angle up to {LARGEST:g} degrees",
                found=shortened(",".join(row)),
                remedy=_REMEDY,
            )
        frames[frame] = angle
    return sorted(frames.items())


def read_frames(path: Path, frames: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """The frames of a video [H, W, 3] uint8 RGB, one after the other.

    Args:
        path: of the video, whose frames stay as they are stored: angles count from their horizontal. frames: numbers,
            counted from 0 and rising.

    Raises:
        PolarguideError: OpenCV cannot read the video, or it ends before the last of them.
    """
    require_file(path, expected="a video", remedy="Copy the file there.")
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        place = -1
        for frame in frames:
            # One by one: many formats seek to the nearest key frame only.
            while place < frame and video.grab():
                place += 1
            picture: Any = None
            if place == frame:
                _, picture = video.retrieve()
            if picture is None or np.ndim(picture) != 3:
                found = f"a video of {place + 1}" if place >= 0 else "a file that OpenCV cannot read"
                raise PolarguideError(
                    path,
                    expected=f"a video with frame {frame}, counted from 0",
                    found=found,
                    remedy="Remove the frame from the table, or save the frames as pictures.",
                )
            yield np.ascontiguousarray(picture[..., ::-1])
    finally:
        video.release()
