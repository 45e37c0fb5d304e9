"""Find photographs through a filter, and their angles: from a table, an option, the folders or the names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.angle_table import TABLE, Line, read_table
from polarguide.capture.filter.shots import SHOT_SUFFIXES
from polarguide.capture.layout import ambiguous, index_files, list_files
from polarguide.capture.polarizer_angles import Angle, angle_text, parse_angle
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError

NAMING = (
    "Name files like cup_045.jpg, cup_a30.jpg, cup_unknown.jpg or cup_none.jpg (numbers without a letter are multiples "
    "of 15), or write angles.csv with the columns file,angle, or give --angles unknown."
)
_WORDS = "unknown|none"
_NUMBER = r"(?P<mark>angle|pol|a|i)?[-_ ]?(?P<angle>\d{1,3}(?:\.\d+)?)(?P<unit>deg)?"
_SUFFIX = re.compile(rf"(?P<view>.+?)[-_ .]+(?:{_NUMBER}|(?P<word>{_WORDS}))", re.IGNORECASE)
_FOLDER = re.compile(rf"{_NUMBER}|(?P<word>{_WORDS})", re.IGNORECASE)
_MARKS = 15
"""Degrees between the marks of a filter's ring: other numbers need a letter, as they may count pictures."""


@dataclass(frozen=True)
class SingleShot:
    """A photograph through a filter, or without one.

    Attributes:
        path: the file.
        view: its view; photographs of one view share their pose.
        angle: of the filter, as the user counts it.
        gain: exposure relative to the others, if the user knows it.
    """

    path: Path
    view: str
    angle: Angle
    gain: float | None = None


def find_single_shots(root: Path, angles: str | None = None) -> tuple[list[SingleShot], list[Path]]:
    """The photographs of a folder, sorted by view, and the tables that were read.

    The angle of each comes from the option, else from ``angles.csv`` in the folder, else from the folders in it
    (``0``, ``30``, ``unknown``, ``none``, ...), else from the names of the files (``cup_045.jpg``, ``cup_a30.jpg``).
    Files that share all of their name but the angle, and lines of a table with one view, are one view.

    Args:
        root: the folder.
        angles: "unknown" or "none" for all, angles in the order of the names such as 0,60,120 that repeat, or the path
            of a table.

    Raises:
        PolarguideError: a photograph has no angle or two, a file of the table does not exist, two photographs are one
            exposure, or the options contradict each other.
    """
    table = root / TABLE
    if angles is not None and table.exists() and Path(angles).resolve() != table.resolve():
        raise PolarguideError(
            "--angles",
            expected=f"nothing beside {table}, which says the angles",
            found=angles,
            remedy="Leave out the option, or move the table away.",
        )
    if angles is not None and not angles.lower().endswith(".csv"):
        shots = _all_alike(root, angles)
        return _checked(root, shots), []
    if angles is not None or table.exists():
        table = Path(angles) if angles is not None else table
        return _checked(root, _by_table(root, table, read_table(table))), [table]
    files = list_files(root, SHOT_SUFFIXES)
    folders = {} if files else folders_of_angles(root)
    if folders:
        shots = [
            SingleShot(path, stem, angle)
            for folder, angle in folders.items()
            for stem, path in index_files(folder, SHOT_SUFFIXES).items()
        ]
        return _checked(root, shots), []
    named = {path: split_name(path.stem) for path in files}
    without = [path.name for path, found in named.items() if found is None]
    if without:
        raise PolarguideError(
            root,
            expected="an angle in the name of every photograph",
            found=f"{len(without)} of {len(files)} without one ({listed(without)})",
            remedy=NAMING,
        )
    shots = [SingleShot(path, *found) for path, found in named.items() if found is not None]
    return _checked(root, shots), []


def split_name(stem: str) -> tuple[str, Angle] | None:
    """View and angle in a file's name; None where it states no angle."""
    match = _SUFFIX.fullmatch(stem)
    angle = None if match is None else _angle_of(match)
    return None if match is None or angle is None else (match["view"], angle)


def folders_of_angles(root: Path) -> dict[Path, Angle]:
    """The folders in a folder that are named like angles, in the order of their names."""
    found: dict[Path, Angle] = {}
    for path in sorted(root.iterdir()):
        match = _FOLDER.fullmatch(path.name) if path.is_dir() else None
        angle = None if match is None else _angle_of(match)
        if angle is not None:
            found[path] = angle
    return found


def _angle_of(match: re.Match[str]) -> Angle | None:
    """The angle that a name states; None for numbers that may count pictures."""
    if match["word"]:
        return parse_angle(match["word"])
    number = float(match["angle"])
    certain = match["mark"] or match["unit"] or (number % _MARKS == 0 and number < 180)
    return number if certain and number <= 360 else None


def _all_alike(root: Path, angles: str) -> list[SingleShot]:
    """Photographs whose angles an option says: one word for all, or numbers that repeat."""
    found = [parse_angle(part) for part in angles.split(",")]
    if any(angle is None for angle in found):
        raise PolarguideError(
            "--angles",
            expected="unknown, none, angles in the order of the files such as 0,60,120, or the path of a .csv table",
            found=repr(angles),
            remedy="Correct the value.",
        )
    files = list(index_files(root, SHOT_SUFFIXES).values())
    if len(files) % len(found):
        raise PolarguideError(
            "--angles",
            expected=f"a multiple of {len(found)} photographs, as these angles repeat",
            found=f"{len(files)} in {root}",
            remedy=f"One is missing or too many: say each angle in {TABLE}.",
        )
    repeated = [found[number % len(found)] for number in range(len(files))]
    return [
        SingleShot(path, path.stem, angle)
        for path, angle in zip(files, repeated, strict=True)
        if angle is not None
    ]


def _by_table(root: Path, table: Path, lines: Sequence[Line]) -> list[SingleShot]:
    """The photographs that a table lists: all that there are.

    Raises:
        PolarguideError: one does not exist or is not listed.
    """
    base = root.resolve()
    shots: list[SingleShot] = []
    alone: dict[str, Path] = {}
    for line in lines:
        path = root / line.file
        if not path.resolve().is_relative_to(base):
            raise PolarguideError(
                table, expected=f"files in {root}", found=line.file, remedy="Copy the file there."
            )
        if not path.is_file():
            raise PolarguideError(
                table,
                expected=f"the file {path}",
                found="nothing of this name",
                remedy="Correct the name, or remove the line.",
            )
        if path.suffix.lower() not in SHOT_SUFFIXES:
            raise PolarguideError(
                table,
                expected=f"pictures ({', '.join(SHOT_SUFFIXES)})",
                found=line.file,
                remedy="Remove the line, or convert the file.",
            )
        if line.view is None and path.stem in alone:
            raise ambiguous(root, f"one photograph called {path.stem}", alone[path.stem], path)
        if line.view is None:
            alone[path.stem] = path
        shots.append(SingleShot(path, line.view or path.stem, line.angle, line.gain))
    taken = {shot.path.resolve() for shot in shots}
    without = [path.name for path in list_files(root, SHOT_SUFFIXES) if path.resolve() not in taken]
    if without:
        raise PolarguideError(
            table,
            expected="a line for every photograph in the folder",
            found=f"none for {len(without)} ({listed(without)})",
            remedy="Add the lines (angle unknown if it was not noted), or move the photographs away.",
        )
    return shots


def _checked(root: Path, shots: list[SingleShot]) -> list[SingleShot]:
    """The photographs, sorted by view and angle.

    Raises:
        PolarguideError: a name is no file's, or two photographs of a view have one angle.
    """
    seen: dict[tuple[str, object], Path] = {}
    for shot in shots:
        if (
            any(sign in shot.view for sign in "/\\")
            or shot.view.startswith(".")
            or not shot.view.isprintable()
        ):
            raise PolarguideError(
                root / TABLE,
                expected="names of views that files may have",
                found=repr(shot.view),
                remedy="Rename the view.",
            )
        if shot.angle == "unknown":
            continue
        key = (shot.view, shot.angle if isinstance(shot.angle, str) else shot.angle % 180)
        if key in seen:
            at = "without a filter" if shot.angle == "none" else f"at {angle_text(shot.angle)} degrees"
            raise ambiguous(root, f"one photograph of {shot.view} {at}", seen[key], shot.path)
        seen[key] = shot.path

    def order(shot: SingleShot) -> tuple[str, bool, float, str]:
        word = isinstance(shot.angle, str)
        return shot.view, word, 0.0 if isinstance(shot.angle, str) else shot.angle, shot.path.name

    return sorted(shots, key=order)
