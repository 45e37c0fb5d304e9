"""Find and read the four shots of a view."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.filter.camera_raw import CAMERA_RAW, is_camera_raw, read_camera_raw
from polarguide.capture.filter.exif import orientation
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_picture
from polarguide.capture.layout import ambiguous, angle_folders, index_files, pictures_of_folders
from polarguide.capture.memory import require_memory_of_each
from polarguide.capture.view import ANGLES
from polarguide.capture.view_reader import require_alike
from polarguide.errors import PolarguideError

SHOT_SUFFIXES = (*SUFFIXES, *CAMERA_RAW)
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
    """The four shots of a view as stored.

    Attributes:
        pictures: [4, H, W, 3] uint8 or uint16, by the names of the angles.
        orientation: their EXIF orientation.
        clipped: pixels with a channel of a shot at full scale, [4, H, W].
        dark: pixels that are 0 in all shots and channels, [H, W].
    """

    pictures: NDArray[Any]
    orientation: int
    clipped: NDArray[np.bool_]
    dark: NDArray[np.bool_]


def find_shots(root: Path) -> dict[str, dict[int, Path]]:
    """View -> angle -> file: from four folders named like the angles, or from four suffixes.

    Folders are ``0``, ``45``, ``90``, ``135``, also ``000``, ``I-00``, ``pol_45``, ...; suffixes are the same
    after ``_``, ``-``, a point or a blank: ``cup_0.jpg``, ``cup-I45.jpg``. Files named like the angles alone
    (``I0.png``, ``I45.png``, ...) are one view, called like the folder, where there is nothing else.

    Returns:
        Nothing where neither is found. Angles may be missing; ``require_four_shots`` checks.

    Raises:
        PolarguideError: two files have the same view and angle, or a folder is missing.
    """
    folders = angle_folders(root)
    if folders:
        return pictures_of_folders(root, folders, SHOT_SUFFIXES)
    files = index_files(root, SHOT_SUFFIXES)
    return group_shots(list(files.values()))


def group_shots(files: Sequence[Path]) -> dict[str, dict[int, Path]]:
    """View -> angle -> file, by the names of files; those without an angle in their name are left out.

    Files named like the angles alone are one view, called like their folder, where a folder has nothing else among
    the files.

    Raises:
        PolarguideError: two files have the same view and angle.
    """
    shots: dict[str, dict[int, Path]] = {}
    for folder in dict.fromkeys(path.parent for path in files):
        inside = [path for path in files if path.parent == folder]
        bare = {int(match["angle"]): path for path in inside if (match := _BARE.fullmatch(path.stem))}
        if len(bare) == len(inside) == len(ANGLES):
            shots[folder.resolve().name] = dict(sorted(bare.items()))
            continue
        for path in inside:
            match = _SUFFIX.fullmatch(path.stem)
            if match is None:
                continue
            view = match["view"]
            of_view, angle = shots.setdefault(view, {}), int(match["angle"])
            if angle in of_view:
                raise ambiguous(folder, f"one picture of {view} at {angle} degrees", of_view[angle], path)
            of_view[angle] = path
    return shots


def require_four_shots(root: Path, shots: dict[str, dict[int, Path]]) -> None:
    """Check that every view has its four shots.

    Raises:
        PolarguideError: a shot is missing.
    """
    for view, files in sorted(shots.items()):
        missing = [str(angle) for angle in ANGLES if angle not in files]
        if missing:
            raise PolarguideError(
                root,
                expected=f"the shots of view {view} at 0, 45, 90 and 135 degrees",
                found=f"none at {' and '.join(missing)}",
                remedy="Add the file, or remove the other shots of the view.",
            )


def read_shots(files: dict[int, Path], gains: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Shots:
    """Read the four shots of a view; ``gains`` of R, G and B are for camera raw files.

    Raises:
        PolarguideError: one cannot be read, or they differ in size, depth or orientation.
    """
    remedy = "Make the pictures smaller, all by the same factor."
    require_memory_of_each(list(files.values()), _READ, "four shots", remedy=remedy)
    pictures: list[NDArray[Any]] = []
    codes: list[int] = []
    for angle in ANGLES:
        picture, code = _read_shot(files[angle], gains)
        if pictures:
            require_alike(files[angle], picture, files[0], pictures[0])
        pictures.append(picture)
        codes.append(code)
        if codes[-1] != codes[0]:
            raise PolarguideError(
                files[angle],
                expected=f"EXIF orientation {codes[0]} like {files[0].name}",
                found=str(codes[-1]),
                remedy="Keep the camera still between the four shots, or export them all alike.",
            )
    stack = np.stack(pictures)
    jpeg = files[0].suffix.lower() in (".jpg", ".jpeg")
    full = _JPEG_FULL if jpeg else int(np.iinfo(stack.dtype).max)
    clipped, lit = np.asarray((stack >= full).any(axis=3)), np.asarray(stack.any(axis=(0, 3)))
    return Shots(stack, codes[0], clipped, ~lit)


def _read_shot(path: Path, gains: tuple[float, float, float]) -> tuple[NDArray[Any], int]:
    """Stored values [H, W, 3] of a shot and its EXIF orientation."""
    if is_camera_raw(path):
        return read_camera_raw(path, gains)
    data = read_picture(path)
    return decode_picture(path, data), orientation(data)
