"""Find and read the four shots of a view."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.filter.camera_raw import CAMERA_RAW, is_camera_raw, read_camera_raw
from polarguide.capture.filter.exif import orientation
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_picture
from polarguide.capture.layout import ambiguous, angle_folders, index_files, list_files, require_angle_folders
from polarguide.capture.memory import require_memory_of_each
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES, listed
from polarguide.capture.view_reader import require_alike
from polarguide.errors import PolarguideError

SHOT_SUFFIXES = (*SUFFIXES, *CAMERA_RAW)
Candidates = dict[str, dict[int, list[Path]]]
"""View -> angle -> the files that may be its shot: one, unless names are ambiguous."""
_SUFFIX = re.compile(
    r"(?P<view>.+?)[-_ .]+(?:i|pol|angle)?[-_ ]?(?P<angle>0{1,3}|0?45|0?90|135)(?:deg)?", re.IGNORECASE
)
_BARE = re.compile(r"(?:i|pol|angle)?[-_ ]?(?P<angle>0{1,3}|0?45|0?90|135)(?:deg)?", re.IGNORECASE)
# Compression smears the edge of clipped areas over a few values.
_JPEG_FULL = 250
_READ = 4 * 3 * (2 + 2)
"""Bytes that a pixel of four shots takes at least: as decoded, and stacked."""


@dataclass(frozen=True, eq=False)
class Shots:
    """The shots of a view as stored: four, or K at other angles.

    Attributes:
        pictures: [4, H, W, 3] uint8 or uint16, by the names of the angles; or [K, H, W, 3].
        orientation: their EXIF orientation.
        clipped: pixels with a channel of a shot at full scale, [4, H, W] or [K, H, W].
        dark: pixels that are 0 in all shots and channels, [H, W].
    """

    pictures: NDArray[Any]
    orientation: int
    clipped: NDArray[np.bool_]
    dark: NDArray[np.bool_]


def find_shots(root: Path, *, nested: bool = False) -> dict[str, dict[int, Path]]:
    """View -> angle -> file: from four folders named like the angles, or from four suffixes.

    Folders are ``0``, ``45``, ``90``, ``135``, also ``000``, ``I-00``, ``pol_45``, ...; suffixes are the same
    after ``_``, ``-``, a point or a blank: ``cup_0.jpg``, ``cup-I45.jpg``. Files named like the angles alone
    (``I0.png``, ``I45.png``, ...) are one view, called like the folder, where there is nothing else.

    Args:
        root: the folder.
        nested: read the folders in one that has no pictures itself, such as one for each view or day.

    Returns:
        Nothing where neither is found. Angles may be missing; ``require_four_shots`` checks.

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
    """What ``find_shots`` finds, with every file of a view and angle where there are several, and the other pictures.

    Raises:
        PolarguideError: a folder of an angle is missing, or there are two.
    """
    folders = angle_folders(root)
    if not folders:
        files = list_files(root, SHOT_SUFFIXES)
        if nested and not files and not index_files(root, RAW_SUFFIXES):
            below = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
            files = [file for folder in below for file in list_files(folder, SHOT_SUFFIXES)]
        return group_files(files)
    require_angle_folders(root, folders)
    shots: Candidates = {}
    for angle, folder in folders.items():
        for path in list_files(folder, SHOT_SUFFIXES):
            shots.setdefault(path.stem, {}).setdefault(angle, []).append(path)
    return shots, []


def group_files(files: Sequence[Path]) -> tuple[Candidates, list[Path]]:
    """View -> angle -> files, by their names, and the files without an angle in their name.

    Files named like the angles alone are one view, called like their folder, where a folder has nothing else among
    the files.
    """
    shots: Candidates = {}
    others: list[Path] = []
    for folder in dict.fromkeys(path.parent for path in files):
        inside = [path for path in files if path.parent == folder]
        alone = all(_BARE.fullmatch(path.stem) for path in inside)
        for path in inside:
            match = (_BARE if alone else _SUFFIX).fullmatch(path.stem)
            if match is None:
                others.append(path)
                continue
            view = folder.resolve().name if alone else match["view"]
            shots.setdefault(view, {}).setdefault(int(match["angle"]), []).append(path)
    return {view: dict(sorted(of_view.items())) for view, of_view in shots.items()}, others


def ambiguity(view: str, files: Mapping[int, Sequence[Path]]) -> PolarguideError | None:
    """The error that two files are one shot of a view; None where there is at most one an angle."""
    for angle, (first, *more) in files.items():
        if more:
            return ambiguous(first.parent, f"one picture of {view} at {angle} degrees", first, more[0])
    return None


def require_four_shots(root: Path, shots: dict[str, dict[int, Path]]) -> None:
    """Check that every view has its four shots.

    Raises:
        PolarguideError: a shot is missing.
    """
    counts = [sum(angle in files for files in shots.values()) for angle in ANGLES]
    if all(len(files) == 1 for files in shots.values()) and min(counts) == max(counts) > 0:
        raise PolarguideError(
            root,
            expected="equal names of the four shots of a view in the four folders",
            found=f"{counts[0]} files in each, all under different names ({listed(sorted(shots))})",
            remedy="Name the shots of a view alike; docs/how-to/prepare.md has a command that numbers them in order.",
        )
    for view, files in sorted(shots.items()):
        missing = [str(angle) for angle in ANGLES if angle not in files]
        if missing:
            raise PolarguideError(
                root,
                expected=f"the shots of view {view} at 0, 45, 90 and 135 degrees",
                found=f"none at {' and '.join(missing)}",
                remedy="Add the file, or remove the other shots of the view (prepare --format singles takes any).",
            )


def read_shots(files: dict[int, Path], gains: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Shots:
    """Read the four shots of a view; ``gains`` of R, G and B are for camera raw files.

    Raises:
        PolarguideError: one cannot be read, or they differ in size, depth or orientation.
    """
    remedy = "Make the pictures smaller, all by the same factor."
    require_memory_of_each(list(files.values()), _READ, "four shots", remedy=remedy)
    return read_stack([files[angle] for angle in ANGLES], gains)


def read_stack(paths: Sequence[Path], gains: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Shots:
    """Read the shots of a view, any number; ``gains`` of R, G and B are for camera raw files.

    Raises:
        PolarguideError: one cannot be read, or they differ in size, depth or orientation.
    """
    pictures: list[NDArray[Any]] = []
    codes: list[int] = []
    for path in paths:
        picture, code = _read_shot(path, gains)
        if pictures:
            require_alike(path, picture, paths[0], pictures[0])
        pictures.append(picture)
        codes.append(code)
        if codes[-1] != codes[0]:
            raise PolarguideError(
                path,
                expected=f"EXIF orientation {codes[0]} like {paths[0].name}",
                found=str(codes[-1]),
                remedy="Keep the camera still between the shots of a view, or export them all alike.",
            )
    stack = np.stack(pictures)
    jpeg = paths[0].suffix.lower() in (".jpg", ".jpeg")
    full = _JPEG_FULL if jpeg else int(np.iinfo(stack.dtype).max)
    clipped, lit = np.asarray((stack >= full).any(axis=3)), np.asarray(stack.any(axis=(0, 3)))
    return Shots(stack, codes[0], clipped, ~lit)


def _read_shot(path: Path, gains: tuple[float, float, float]) -> tuple[NDArray[Any], int]:
    """Stored values [H, W, 3] of a shot and its EXIF orientation."""
    if is_camera_raw(path):
        return read_camera_raw(path, gains)
    data = read_picture(path)
    return decode_picture(path, data), orientation(data)
