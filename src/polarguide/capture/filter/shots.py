"""Find and read photographs through a filter: four shots of a view, or single shots at any angles.

Groups of consecutive pictures may show one place. Frames are extracted from videos.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.exposures import (
    NAMING,
    TABLE,
    Angle,
    Line,
    angle_text,
    angles_of_names,
    files_of,
    folders_of_angles,
    parse_angle,
    read_table,
)
from polarguide.capture.filter.camera_files import CAMERA_RAW, is_camera_raw, orientation, read_camera_raw
from polarguide.capture.formats.pictures import decode_picture
from polarguide.capture.formats.stored import SUFFIXES, is_lossy, read_picture, require_alike, rescaled
from polarguide.capture.layout import (
    ambiguous,
    angle_folders,
    index_shot_files,
    list_shot_files,
    require_angle_folders,
    shot_stem,
)
from polarguide.capture.sensor.mosaics import RAW_SUFFIXES
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES
from polarguide.capture.write import write_png_file
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_text
from polarguide.core.progress import Advance, Reporter
from polarguide.core.text import canonical, listed

SHOT_SUFFIXES = (*SUFFIXES, *CAMERA_RAW)
Candidates = dict[str, dict[int, list[Path]]]
"""Files of each shot by view and angle. There are several files of a shot if names are ambiguous."""
_SUFFIX = re.compile(
    r"(?P<view>.+?)[-_ .]+(?:i|pol|angle)?[-_ ]?(?<![_ .]-)(?P<angle>0{1,3}|0?45|0?90|135)(?:deg)?",
    re.IGNORECASE,
)
_BARE = re.compile(r"(?:(?:i|pol|angle)[-_ ]?|[_ ])?(?P<angle>0{1,3}|0?45|0?90|135)(?:deg)?", re.IGNORECASE)
# Compression spreads the values at the edge of clipped areas over a few 8-bit values.
_LOSSY_FULL = 250 / 255
# Smallest memory in bytes per pixel of four shots, decoded and stacked.
_READ = 4 * 3 * (2 + 2)


@dataclass(frozen=True, eq=False)
class Shots:
    """Stored pixels of the K shots of a view.

    Attributes:
        pictures: stored values [K, H, W, 3], uint8 or uint16, in the order of the angles.
        orientation: EXIF orientation of the shots.
        clipped: mask of the pixels of each shot that are at full scale in some channel, [K, H, W].
        dark: mask of the pixels that are 0 in all shots and channels, [H, W].
    """

    pictures: NDArray[Any]
    orientation: int
    clipped: NDArray[np.bool_]
    dark: NDArray[np.bool_]


def find_shots(root: Path, *, nested: bool = False) -> dict[str, dict[int, Path]]:
    """Find the four shots of each view, and return their files by view and angle.

    Each angle has a folder, or the names of the files end with the angle. Folders have names such as ``0``, ``45``,
    ``90`` and ``135``, or ``000``, ``I-00``, ``pol_45``. In names of files, the angle follows after ``_``, ``-``, a
    point or a blank: ``cup_0.jpg``, ``cup-I45.jpg``. If all files of a folder are named by an angle only (``I0.png``,
    ``I45.png``, ...), they are one view with the name of the folder.

    Args:
        root: the folder.
        nested: if True, the subfolders of a folder without pictures are searched, for example one for each day.

    Returns:
        The files. The result is empty if no name has an angle. Angles may be missing, see ``require_four_shots``.

    Raises:
        PolarguideError: two files have the same view and angle, or a folder is missing.
    """
    shots, _ = list_shots(root, nested=nested)
    for view, files in shots.items():
        fault = ambiguity(view, files)
        if fault is not None:
            raise fault
    return {view: {angle: paths[0] for angle, paths in files.items()} for view, files in shots.items()}


def list_shots(root: Path, *, nested: bool = False) -> tuple[Candidates, list[Path]]:
    """Find the shots of each view like ``find_shots``, without an error for ambiguous names.

    Returns:
        All files of each view and angle; and the pictures whose names have no angle.

    Raises:
        PolarguideError: the folder of an angle is missing, or an angle has two folders.
    """
    folders = angle_folders(root)
    if not folders:
        files = list_shot_files(root, SHOT_SUFFIXES)
        if nested and not files and not index_shot_files(root, RAW_SUFFIXES):
            below = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
            files = [file for folder in below for file in list_shot_files(folder, SHOT_SUFFIXES)]
        return group_files(files)
    require_angle_folders(root, folders)
    shots: Candidates = {}
    for angle, folder in folders.items():
        for path in list_shot_files(folder, SHOT_SUFFIXES):
            shots.setdefault(shot_stem(path), {}).setdefault(angle, []).append(path)
    if not shots:
        _refuse_other_formats(folders.values())
    return shots, []


def _refuse_other_formats(folders: Iterable[Path]) -> None:
    """Refuse folders of angles whose files all have unsupported formats.

    Raises:
        PolarguideError: a folder contains such files.
    """
    for folder in folders:
        files = [
            path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith(".")
        ]
        kinds = Counter(path.suffix.lower() or "no suffix" for path in files)
        if kinds:
            raise PolarguideError(
                folder,
                expected=f"shots in a supported format ({', '.join(SHOT_SUFFIXES)})",
                found=", ".join(f"{count} of {kind}" for kind, count in kinds.most_common(3)),
                remedy="Export them as 16-bit TIFF, linear if possible, or as JPEG of the highest quality.",
            )


def group_files(files: Sequence[Path]) -> tuple[Candidates, list[Path]]:
    """Group files by the view and angle in their names.

    If all files of a folder are named by an angle only, they are one view with the name of the folder.

    Returns:
        The files by view and angle; and the files whose names have no angle.
    """
    shots: Candidates = {}
    others: list[Path] = []
    for folder in dict.fromkeys(path.parent for path in files):
        inside = [path for path in files if path.parent == folder]
        alone = all(_BARE.fullmatch(shot_stem(path)) for path in inside)
        for path in inside:
            match = (_BARE if alone else _SUFFIX).fullmatch(shot_stem(path))
            if match is None:
                others.append(path)
                continue
            view = canonical(folder.resolve().name) if alone else match["view"]
            shots.setdefault(view, {}).setdefault(int(match["angle"]), []).append(path)
    return {view: dict(sorted(by_angle.items())) for view, by_angle in shots.items()}, others


def ambiguity(view: str, files: Mapping[int, Sequence[Path]]) -> PolarguideError | None:
    """Return the error for a view with two files of the same shot. Return None if each shot has one file."""
    for angle, (first, *more) in files.items():
        if more:
            return ambiguous(first.parent, f"one picture of {view} at {angle} degrees", first, more[0])
    return None


def require_four_shots(root: Path, shots: dict[str, dict[int, Path]]) -> None:
    """Check that every view has four shots.

    Raises:
        PolarguideError: a shot is missing.
    """
    counts = [sum(angle in files for files in shots.values()) for angle in ANGLES]
    require(
        not all(len(files) == 1 for files in shots.values()) or not min(counts) == max(counts) > 0,
        root,
        expected="equal names of the four shots of a view in the four folders",
        found=f"{counts[0]} files in each, all under different names ({listed(sorted(shots))})",
        remedy="Give the shots of a view one name; docs/how-to/prepare.md has a command that numbers them.",
    )
    for view, files in sorted(shots.items()):
        missing = [str(angle) for angle in ANGLES if angle not in files]
        require(
            not missing,
            root,
            expected=f"the shots of view {view} at 0, 45, 90 and 135 degrees",
            found=f"none at {' and '.join(missing)}",
            remedy="Add the file, or remove the other shots of the view. prepare --format singles accepts any.",
        )


def read_stack(paths: Sequence[Path], levels: Levels | None = None) -> Shots:
    """Read the shots of a view. There may be any number of shots.

    Args:
        paths: files of the shots.
        levels: levels of the stored values. The values are rescaled so that full scale is the largest value of their
            type. By default, the files already have this full scale.

    Raises:
        PolarguideError: a file cannot be read, or files differ in size, depth or orientation.
    """
    pictures, codes = zip(*map(_read_shot, paths), strict=True)
    for path, picture, code in zip(paths, pictures, codes, strict=True):
        require_alike(path, picture, paths[0], pictures[0])
        require(
            code == codes[0],
            path,
            expected=f"EXIF orientation {codes[0]} like {paths[0].name}",
            found=str(code),
            remedy="Do not move the camera between the shots of a view, or export all with the same settings.",
        )
    return stacked(np.stack(pictures), codes[0], lossy=is_lossy(paths[0]), levels=levels)


def stacked(
    stack: NDArray[Any], orientation: int = 1, *, lossy: bool = False, levels: Levels | None = None
) -> Shots:
    """Create the shots of a view from their stored values.

    Args:
        stack: stored values, [K, H, W, 3].
        orientation: EXIF orientation.
        lossy: True if the files have a lossy compression.
        levels: levels of the stored values, see ``read_stack``.
    """
    full = int(np.iinfo(stack.dtype).max)
    limit = round(_LOSSY_FULL * full) if lossy else full
    # The maximum of the three colors. NumPy reduces a last axis of three slowly.
    top = np.maximum(np.maximum(stack[..., 0], stack[..., 1]), stack[..., 2])
    if levels is not None:
        limit = min(limit, levels.saturation)
        stack = stack if levels.white == full else rescaled(stack, levels.white)
    return Shots(stack, orientation, np.asarray(top >= limit), ~top.any(axis=0))


def _read_shot(path: Path) -> tuple[NDArray[Any], int]:
    """Read a shot, and return its stored values [H, W, 3] and its EXIF orientation."""
    if is_camera_raw(path):
        return read_camera_raw(path)
    data = read_picture(path)
    return decode_picture(path, data), orientation(data)


@dataclass(frozen=True)
class SingleShot:
    """Photograph through a filter at any angle, or without a filter.

    Attributes:
        path: file of the photograph.
        view: name of the view. All photographs of a view have the same pose.
        angle: angle of the filter that the user stated.
        gain: exposure relative to the other photographs that the user stated, or None.
    """

    path: Path
    view: str
    angle: Angle
    gain: float | None = None


def find_single_shots(
    root: Path, angles: str | None = None, each: int = 1
) -> tuple[list[SingleShot], list[Path]]:
    """Find the photographs of a folder with their views and angles.

    The argument ``angles`` specifies the angles. Without it, they are read from the table ``angles.csv`` in the folder.
    Without this table, the names of the subfolders are angles (``0``, ``30``, ``unknown``, ``none``, ...), or the names
    of the files contain angles (``cup_045.jpg``, ``cup_a30.jpg``). Files whose names differ only in the angle belong to
    one view. A table may state the view of each file.

    Args:
        root: the folder.
        angles: "unknown" or "none" for all photographs; repeating angles in the order of the names, such as 0,60,120;
            or the path of a table.
        each: number of consecutive photographs of each view. The view has the name of its first photograph. It requires
            ``angles``.

    Returns:
        The photographs, sorted by view; and the tables that were read.

    Raises:
        PolarguideError: a photograph has no angle or two, a file of the table does not exist, two photographs are one
            exposure, or the options contradict each other.
    """
    table = root / TABLE
    require(
        angles is None or not table.exists() or Path(angles).resolve() == table.resolve(),
        "--angles",
        expected=f"no --angles with {table}, which states the angles",
        found=str(angles),
        remedy="Omit the option, or move the table to another folder.",
    )
    if angles is not None and not angles.lower().endswith(".csv"):
        return _validated(root, _with_angles(root, angles, each)), []
    if angles is not None or table.exists():
        table = Path(angles) if angles is not None else table
        return _validated(root, _by_table(root, table)), [table]
    files = list_shot_files(root, SHOT_SUFFIXES)
    shots = [
        SingleShot(path, stem, angle)
        for folder, angle in ({} if files else folders_of_angles(root)).items()
        for stem, path in index_shot_files(folder, SHOT_SUFFIXES).items()
    ]
    if shots:
        return _validated(root, shots), []
    named = dict(zip(files, views_of_names(root, files), strict=True))
    without = [path.name for path, shot in named.items() if shot is None]
    require(
        not without,
        root,
        expected="an angle in the name of every photograph",
        found=f"{len(without)} of {len(files)} without an angle in their names ({listed(without)})",
        remedy=NAMING,
    )
    return _validated(root, [SingleShot(path, *shot) for path, shot in named.items() if shot is not None]), []


def views_of_names(folder: Path, files: Sequence[Path]) -> list[tuple[str, Angle] | None]:
    """Return the view and the angle in the name of each file of a folder.

    The result is ``None`` for a name without an angle. If all files are named by an angle only, they are one view with
    the name of the folder.
    """
    names = angles_of_names([shot_stem(path) for path in files])
    alone = all(name is not None and not name[0] for name in names)
    own = canonical(folder.resolve().name) if alone else ""
    return [(name[0] or own, name[1]) if name is not None and (name[0] or alone) else None for name in names]


def _with_angles(root: Path, angles: str, each: int) -> list[SingleShot]:
    """Find the photographs of a folder, and assign the angles that the user specified.

    Args:
        root: the folder.
        angles: one word for all photographs, or repeating angles in the order of the names.
        each: number of consecutive photographs of each view, or None.
    """
    repeating = [parse_angle(part) for part in angles.split(",")]
    if any(angle is None for angle in repeating):
        raise PolarguideError(
            "--angles",
            expected="'unknown', 'none', angles in the order of the files ('0,60,120'), or the path of a .csv table",
            found=repr(angles),
            remedy="Use one of these four.",
        )
    files = list(index_shot_files(root, SHOT_SUFFIXES).values())
    period = max(each, len(repeating))
    require(
        not len(files) % period and len(repeating) in (1, period),
        "--angles",
        expected=f"a number of photographs divisible by {period}, and one angle or {period} repeating angles",
        found=f"{len(files)} in {root} and {len(repeating)} angles",
        remedy=f"Add or remove photographs, or list the angle of each in {TABLE}.",
    )
    repeated = [repeating[number % len(repeating)] for number in range(len(files))]
    return [
        SingleShot(path, shot_stem(files[number - number % each]), angle)
        for number, (path, angle) in enumerate(zip(files, repeated, strict=True))
        if angle is not None
    ]


def listed_pictures(root: Path, table: Path) -> tuple[list[tuple[Line, Path]], list[Path]]:
    """Match the lines of a table with the pictures of a folder.

    Returns:
        Each line with the path of its picture; and the pictures that the table does not list.

    Raises:
        PolarguideError: the table cannot be read, or lists a file that is outside the folder or has an unsupported
            format.
    """
    lines = read_table(table)
    rows = list(zip(lines, files_of(root, table, lines), strict=True))
    for line, path in rows:
        require(
            path.resolve().is_relative_to(root.resolve()) and path.suffix.lower() in SHOT_SUFFIXES,
            f"{table} (line {line.number})",
            expected=f"a picture in {root} ({', '.join(SHOT_SUFFIXES)})",
            found=line.file,
            remedy="Copy or convert the file, or remove the line.",
        )
    in_table = {path.resolve() for _, path in rows}
    return rows, [path for path in list_shot_files(root, SHOT_SUFFIXES) if path.resolve() not in in_table]


def _by_table(root: Path, table: Path) -> list[SingleShot]:
    """Return the photographs that a table lists.

    Raises:
        PolarguideError: a photograph does not exist or is not listed.
    """
    rows, without = listed_pictures(root, table)
    shots: list[SingleShot] = []
    alone: dict[str, Path] = {}
    for line, path in rows:
        require(
            path.is_file(),
            table,
            expected=f"the file {path}",
            found="nothing with this name",
            remedy="Correct the name, or remove the line.",
        )
        stem = shot_stem(path)
        if line.view is None and alone.setdefault(stem, path) is not path:
            raise ambiguous(root, f"one photograph called {stem}", alone[stem], path)
        shots.append(SingleShot(path, line.view or stem, line.angle, line.gain))
    require(
        not without,
        table,
        expected="a line for every photograph in the folder",
        found=f"none for {len(without)} ({listed([path.name for path in without])})",
        remedy="Add the lines, with the angle unknown if it was not noted, or remove the photographs.",
    )
    return shots


def _validated(root: Path, shots: list[SingleShot]) -> list[SingleShot]:
    """Validate photographs, and return them sorted by view and angle.

    Raises:
        PolarguideError: the name of a view is no valid file name, or two photographs of a view have the same angle.
    """
    first: dict[tuple[str, object], Path] = {}
    for shot in shots:
        require(
            not any(sign in shot.view for sign in "/\\")
            and not shot.view.startswith(".")
            and shot.view.isprintable(),
            root / TABLE,
            expected="a view name that can be a file name",
            found=repr(shot.view),
            remedy="Rename the view.",
        )
        if shot.angle == "unknown":
            continue
        key = (shot.view, shot.angle)  # angles that differ by 180 degrees are repetitions and valid
        if key in first:
            at = "without a filter" if shot.angle == "none" else f"at {angle_text(shot.angle)} degrees"
            raise ambiguous(root, f"one photograph of {shot.view} {at}", first[key], shot.path)
        first[key] = shot.path
    return sorted(shots, key=lambda shot: (shot.view, *angle_order(shot.angle), shot.path.name))


def angle_order(angle: Angle) -> tuple[bool, float]:
    """Return the key by which angles are sorted. Words follow after all numbers."""
    return (True, 0.0) if isinstance(angle, str) else (False, angle)


VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
MOST_SHOTS = 12
"""Largest number of shots of one place. It is sufficient for one shot every 15 degrees over 180 degrees."""
_SAMPLED = 24
_SIDE = 96
_BLUR = 4.0
_APART = 2.0
"""Smallest ratio of the differences between pictures of different groups to those within a group."""


def shots_of_one_place(paths: Sequence[Path]) -> int | None:
    """Return the number of consecutive pictures that show one place. Return None if there are no such groups.

    A rotating filter changes reflections but moves no edge. Consecutive pictures are therefore compared without low
    frequencies. Differences within groups must be much smaller than between groups. Only the first pictures are read.

    Raises:
        PolarguideError: a picture cannot be read.
    """
    count = len(paths)
    sizes = [size for size in range(2, MOST_SHOTS + 1) if count % size == 0 and count // size >= 3]
    if not sizes:
        return None
    pictures = [_edges(path) for path in paths[: max(_SAMPLED, 3 * max(sizes))]]
    # One minus the correlation.
    steps = np.array([1.0 - float((a * b).mean()) for a, b in itertools.pairwise(pictures)])
    places = np.arange(1, len(steps) + 1)
    for size in sizes:
        between = places % size == 0
        if np.percentile(steps[between], 10) > _APART * np.percentile(steps[~between], 90):
            return size
    return None


def _edges(path: Path) -> NDArray[np.float32]:
    """Return a small gray picture without low frequencies, with a standard deviation of 1."""
    raw = is_camera_raw(path)
    pixels = read_camera_raw(path)[0] if raw else decode_picture(path, read_picture(path))
    small = cv2.resize(
        np.sqrt(pixels.mean(axis=2, dtype=np.float32)), (_SIDE, _SIDE), interpolation=cv2.INTER_AREA
    )
    fine = small - cv2.GaussianBlur(small, (0, 0), _BLUR)
    return np.asarray(fine / max(float(fine.std()), 1e-6), np.float32)


FRAMES_A_SECOND = 2.0
"""Number of frames per second of a video that are used.

If the camera moves around a subject in a minute, it turns by 3 degrees between two of these frames.
"""
LEAST_FRAMES = 24
MOST_FRAMES = 120
_RECORD = "video.txt"


def find_videos(root: Path) -> list[Path]:
    """Return the videos in a folder. If ``root`` is a video file, return it."""
    files = [root] if root.is_file() else sorted(root.iterdir()) if root.is_dir() else []
    return [path for path in files if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES]


def extract_frames(video: Path, folder: Path, reporter: Reporter) -> int:
    """Write the sharpest frame of each time interval of a video as a PNG file, and return the number of frames.

    Frames are rotated for display. The files of an earlier call for the same video are reused.

    Raises:
        PolarguideError: OpenCV cannot read the video, or it has too few frames.
    """
    status = video.stat()
    record = f"{video.resolve()} {status.st_size} {status.st_mtime_ns}\n"
    done = folder / _RECORD
    if done.is_file() and done.read_text() == record:
        return len(list(folder.glob("frame_*.png")))
    require(
        not folder.exists() or not any(folder.iterdir()) or done.is_file(),
        folder,
        expected="a new folder for the frames of the video",
        found="other files",
        remedy="Choose another --out: the folder of the frames is next to it.",
    )
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    rate = reader.get(cv2.CAP_PROP_FPS) or 25.0
    wanted = int(np.clip(FRAMES_A_SECOND * total / rate, LEAST_FRAMES, MOST_FRAMES))
    require(
        total >= 3,
        video,
        expected="a video that OpenCV reads",
        found=f"{max(total, 0)} frames",
        remedy="Convert it to H.264 in .mp4, or save its frames as pictures.",
    )
    make_folder(folder)
    write_text(done, "unfinished\n")
    for old in folder.glob("frame_*.png"):
        old.unlink()
    written = 0
    with reporter.track("reading frames", total) as advance:
        frames = enumerate(_frames(reader, total, advance))
        for _, interval in itertools.groupby(frames, key=lambda frame: frame[0] * wanted // total):
            _, sharpest = max(interval, key=lambda frame: _sharpness(frame[1]))
            write_png_file(folder / f"frame_{written:04d}.png", np.ascontiguousarray(sharpest[..., ::-1]))
            written += 1
    reader.release()
    write_text(done, record)
    return written


def _frames(reader: cv2.VideoCapture, total: int, advance: Advance) -> Iterator[NDArray[np.uint8]]:
    """Yield up to ``total`` frames of a video, BGR."""
    for number in range(total):
        is_read, picture = reader.read()
        if not is_read:
            return
        advance(number + 1)
        yield np.asarray(picture, np.uint8)


def _sharpness(picture: NDArray[np.uint8]) -> float:
    return float(cv2.Laplacian(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.CV_32F).var())


_MANY = 100
"""Largest number of pictures whose pairs are all compared, even if their names are numbered. They form 4950 pairs."""
_NUMBERED = re.compile(r"(?P<name>.*?)(?P<number>\d+)")
_NEIGHBORS = 20
"""Approximate number of pictures that COLMAP compares with each picture in sequential matching."""


def chosen_matching(views: Sequence[str], matching: str, reporter: Reporter) -> str:
    """Choose the matching of pictures, "exhaustive" or "sequential".

    A message informs the user about the choice for ``auto``, or about a faster alternative.

    Args:
        views: names of the views in their order.
        matching: matching that the user requested.
        reporter: reporter of the message.
    """
    if matching != "auto":
        return matching
    names = [_NUMBERED.fullmatch(view) for view in views]
    numbers = [int(name["number"]) for name in names if name is not None]
    running = len(numbers) == len(views) and len({name["name"] for name in names if name is not None}) == 1
    running = running and numbers[-1] - numbers[0] < 2 * len(numbers)
    frames = running and views[0].lower().startswith("frame")
    pairs = len(views) * (len(views) - 1) // 2
    few = _NEIGHBORS * len(views)
    if pairs > few and (frames or (running and len(views) > _MANY)):
        kind = "frames of a video" if frames else "running numbers"
        reporter.say(
            f"Matching: about {few} pairs of neighbors ({kind}); --matching exhaustive compares all {pairs}."
        )
        return "sequential"
    if pairs > 2 * few or (running and pairs > few):
        option = "If consecutive pictures by name overlap, --matching sequential compares about"
        reporter.say(f"Matching: all {pairs} pairs. {option} {few}.")
    return "exhaustive"
