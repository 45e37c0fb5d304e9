"""Find sets of pictures at any polarizer angles, by file names, folders, a table, or the frames of a video."""

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
    angle_text,
    angles_of_names,
    conditioning,
    covers_turn,
    folders_of_angles,
    nominal,
    normalized,
    parse_angle,
)
from polarguide.capture.filter.shots import (
    SHOT_SUFFIXES,
    VIDEO_SUFFIXES,
    angle_order,
    group_files,
    listed_pictures,
    views_of_names,
)
from polarguide.capture.layout import all_exposures, ambiguous, exposure_tables, list_shot_files, shot_stem
from polarguide.capture.view import ANGLES, listed
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import read_rows, require_file
from polarguide.core.records import shortened
from polarguide.core.text import canonical, stem_of, whole_number
from polarguide_shots.options import Kind


@dataclass(frozen=True)
class SetPicture:
    """One picture of a set.

    Attributes:
        path: path of the picture, or of the video.
        angle: angle of the polarizer in degrees, in the user's direction of counting. "unknown" if it is unknown,
            "none" if there was no polarizer. Only pictures at known angles are used.
        gain: exposure relative to the other pictures if a table states it, else None.
        frame: number of the frame in a video, counted from 0. None for a picture file.
    """

    path: Path
    angle: Angle
    gain: float | None = None
    frame: int | None = None

    @property
    def label(self) -> str:
        """Name of the picture in messages."""
        return self.path.name if self.frame is None else f"{self.path.name} frame {self.frame}"


@dataclass(frozen=True)
class ExposureSet:
    """The files of one shot, or its pictures in memory.

    Attributes:
        name: name that is unique among the sets of one search and valid in a file name.
        kind: "mosaic" is one raw file. "filter" has one file each at 0, 45, 90 and 135 degrees. "set" has pictures at
            any angles. "scene" is a view of a scene folder.
        files: files by angle. The file of a mosaic has the key 0. The dictionary is empty for a set. ``read_shot``
            reports missing angles.
        root: folder of the scene, else None.
        view: name of the view in the scene.
        fault: error of an invalid shot, which ``read_shot`` raises. The remaining shots of the search are not affected.
        others: files of an invalid shot that are not in ``files``, or its folder. For a view of a scene, the pictures
            at unusual angles.
        pictures: pictures of a set, by angle.
        table: table with the angles of the pictures. None if names state the angles.
        stored: pictures of a shot in memory: [H, W] for a mosaic, else [K, H, W, 3].
        angles: angles of the pictures in memory, in the user's direction of counting. Empty for a mosaic.
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
        """All files of the shot: pictures by angle, then the table of a set. Empty for a shot in memory.

        Further exposures of the pictures and the table of exposures are at the end.
        """
        pictures = [path for _, path in sorted(self.files.items())]
        pictures += dict.fromkeys(picture.path for picture in self.pictures)
        table = [] if self.table is None else [self.table]
        bracketed = [] if self.root is not None else [*all_exposures(pictures), *exposure_tables(pictures)]
        return tuple(dict.fromkeys((*pictures, *table, *self.others, *bracketed)))

    @property
    def where(self) -> Path | str:
        """First file of the shot, or its name, for messages."""
        return self.paths[0] if self.paths else self.name

    @property
    def complete(self) -> bool:
        """True if all pictures of a set have arrived: a table lists them, or their angles cover half a turn evenly."""
        angles = [picture.angle for picture in self.pictures if not isinstance(picture.angle, str)]
        return self.table is not None or covers_turn([angle % 180 for angle in angles])

    @property
    def empty(self) -> bool:
        """True if the set consists only of an error, without a picture."""
        return self.fault is not None and not (self.files or self.pictures)


def require_determined(where: object, angles: Sequence[Angle]) -> None:
    """Check that pictures at some angles determine a Stokes vector well.

    Raises:
        PolarguideError: fewer than three known angles differ modulo 180 degrees, or all angles are too similar.
    """
    texts = listed([angle_text(angle) for angle in angles], 12)
    exposures = [Exposure(normalized(angle)) for angle in angles if not isinstance(angle, str)]
    different = len({round(e.angle or 0.0, 6) % 180 for e in exposures})
    require(
        different >= FEWEST,
        where,
        expected="pictures at three or more different angles (modulo 180 degrees)",
        found=f"{different} ({texts})",
        remedy="Add pictures: 0, 60 and 120 degrees are enough.",
    )
    condition = conditioning(nominal(exposures))
    require(
        condition >= WELL_CONDITIONED,
        where,
        expected=f"angles spread over half a turn, with a conditioning of {WELL_CONDITIONED:g} or more",
        found=f"{condition:.2g} ({texts})",
        remedy="Turn the polarizer further: 0, 60 and 120 degrees have 0.71.",
    )


def known_indices(view: str, exposures: Sequence[Exposure]) -> list[int]:
    """Return the indices of the pictures of a view whose angles are known.

    Raises:
        PolarguideError: the angles do not determine Stokes vectors.
    """
    angles: list[Angle] = [
        e.angle if e.angle is not None else "unknown" if e.filtered else "none" for e in exposures
    ]
    require_determined(f"view {view}", angles)
    return [index for index, angle in enumerate(angles) if not isinstance(angle, str)]


def _exposure_set(
    name: str,
    pictures: Iterable[SetPicture],
    table: Path | None = None,
    fault: PolarguideError | None = None,
) -> ExposureSet:
    """Create a set from pictures, which are sorted by angle.

    The set has a fault if its angles do not determine Stokes vectors. Its kind is "filter" if it has exactly one
    picture at each of 0, 45, 90 and 135 degrees, and no gains.
    """
    ordered = tuple(sorted(pictures, key=lambda p: (*angle_order(p.angle), p.path.name, p.frame or 0)))
    if fault is None:
        try:
            require_determined(f"{(table or ordered[0].path.parent)} ({name})", [p.angle for p in ordered])
        except PolarguideError as error:
            fault = error
    four = {int(p.angle): p.path for p in ordered if p.angle in ANGLES and p.gain is None and p.frame is None}
    if fault is None and len(four) == len(ordered) == len(ANGLES):
        return ExposureSet(name, "filter", four, table=table)
    return ExposureSet(name, "set", {}, fault=fault, pictures=ordered, table=table)


def by_name(files: Sequence[Path]) -> tuple[list[ExposureSet], list[Path]]:
    """Find sets by the names of files.

    If the names of all files in a folder are only angles, the files form one set with the name of the folder.

    Returns:
        The sets; and the remaining files. The remaining files have the four usual angles, or no angle in their names.
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
        for view, pictures in sorted(views.items()):
            paths = [picture.path for picture in pictures]
            four = all(picture.angle in ANGLES for picture in pictures)
            # Only this function knows names with a mark such as cup_a45.
            if four and not (len(paths) == 4 and group_files(paths)[1]):
                rest += paths
            else:
                sets.append(_named_set(folder, view, pictures))
    return sets, rest


def by_folder(root: Path) -> list[ExposureSet]:
    """Find sets in folders whose names are angles, each with one file of each view.

    Return an empty list if all folders have one of the four usual angles.
    """
    views: dict[str, list[SetPicture]] = {}
    for folder, angle in folders_of_angles(root).items():
        for path in list_shot_files(folder, SHOT_SUFFIXES):
            views.setdefault(shot_stem(path), []).append(SetPicture(path, angle))
    if all(picture.angle in ANGLES for pictures in views.values() for picture in pictures):
        return []
    return [_named_set(root, view, pictures) for view, pictures in sorted(views.items())]


def _named_set(folder: Path, view: str, pictures: Sequence[SetPicture]) -> ExposureSet:
    """Create a set whose file names state the angles. The set has a fault if two files have the same angle."""
    first: dict[Angle, Path] = {}
    for picture in pictures:
        earlier = first.setdefault(picture.angle, picture.path)
        if earlier is not picture.path:
            return _exposure_set(
                view,
                pictures,
                fault=ambiguous(
                    folder,
                    f"one picture of {view} at {angle_text(picture.angle)} degrees",
                    earlier,
                    picture.path,
                ),
            )
    return _exposure_set(view, pictures)


def by_table(root: Path) -> tuple[list[ExposureSet], list[Path]]:
    """Read the sets in the table ``angles.csv`` of a folder.

    Lines with the same view form one set. Lines without a view are grouped by the views in their file names. If a file
    name contains no view, all lines without a view form one set with the name of the folder. An angle may occur several
    times.

    Returns:
        The sets; and the pictures of the folder that are not in the table.

    Raises:
        PolarguideError: the table cannot be read, or lists files outside of the folder or of other types.
    """
    table = root / TABLE
    rows, others = listed_pictures(root, table)
    unnamed = [line.file for line, _ in rows if line.view is None]
    names = angles_of_names([stem_of(Path(file)) for file in unnamed])
    all_named = all(name is not None and name[0] for name in names)
    view_of = {
        file: name[0] if all_named and name is not None else canonical(root.resolve().name)
        for file, name in zip(unnamed, names, strict=True)
    }
    views: dict[str, list[SetPicture]] = {}
    for line, path in rows:
        view = view_of[line.file] if line.view is None else line.view
        views.setdefault(view, []).append(SetPicture(path, line.angle, line.gain))
    return [_table_set(table, view, pictures) for view, pictures in sorted(views.items())], others


def _table_set(table: Path, view: str, pictures: Sequence[SetPicture]) -> ExposureSet:
    """Create the set of the pictures of one view in a table. The set has a fault if a file is missing."""
    existing = [picture for picture in pictures if picture.path.is_file()]
    missing = [picture.path for picture in pictures if picture not in existing]
    if not missing:
        return _exposure_set(view, existing, table)
    fault = PolarguideError(
        table,
        expected=f"the file {missing[0]}",
        found="nothing of this name",
        remedy="Correct the file's name in the table, or remove its line.",
    )
    return _exposure_set(view, existing, table, fault)


def videos(files: Sequence[Path]) -> list[ExposureSet]:
    """Create a set for each video among some files. The table next to the video lists the frames."""
    sets = []
    for path in (path for path in files if path.suffix.lower() in VIDEO_SUFFIXES):
        table = path.with_suffix(".csv")
        try:
            frames = read_frame_table(table, path)
        except PolarguideError as error:
            sets.append(_exposure_set(stem_of(path), [SetPicture(path, "unknown")], None, error))
        else:
            pictures = [SetPicture(path, angle, None, frame) for frame, angle in frames]
            sets.append(_exposure_set(stem_of(path), pictures, table))
    return sets


_REMEDY = "Write a line for each frame to use: its number, counted from 0, and its angle in degrees."


def read_frame_table(path: Path, video: Path) -> list[tuple[int, Angle]]:
    """Read the table of a video, which has the columns ``frame,angle``.

    Returns:
        Pairs of a frame, counted from 0, and its angle.

    Raises:
        PolarguideError: the table is missing, a cell is invalid, or a frame is repeated.
    """
    require(
        path.is_file(),
        path,
        expected=f"a table with the columns frame,angle for {video.name}",
        found="no such file",
        remedy=_REMEDY,
    )
    rows = read_rows(path, _REMEDY)
    header = ",".join(rows[0][1]).lower() if rows else ""
    require(
        header == "frame,angle",
        f"{path} (line 1)",
        expected='the header "frame,angle"',
        found=shortened(header) if header else "an empty file",
        remedy=_REMEDY,
    )
    frames: dict[int, Angle] = {}
    for number, row in rows[1:]:
        angle = parse_angle(row[1]) if len(row) == 2 else None
        frame = whole_number(row[0])
        if angle is None or frame is None or frame in frames:
            raise PolarguideError(
                f"{path} (line {number})",
                expected=f"a frame number that occurs only once, and an angle of at most {LARGEST:g} degrees",
                found=shortened(",".join(row)),
                remedy=_REMEDY,
            )
        frames[frame] = angle
    return sorted(frames.items())


def read_frames(path: Path, frames: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """Read frames of a video [H, W, 3] uint8 RGB, one after the other.

    Frames keep their stored orientation, because angles are counted from the horizontal of the stored frame.

    Args:
        path: path of the video.
        frames: numbers of the frames, counted from 0, in ascending order.

    Raises:
        PolarguideError: OpenCV cannot read the video, or the video is too short.
    """
    require_file(path, expected="a video", remedy="Copy the file there.")
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        place = -1
        for frame in frames:
            # Sequential reading: many formats seek to the nearest key frame only.
            while place < frame and video.grab():
                place += 1
            picture: Any = video.retrieve()[1] if place == frame else None
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
