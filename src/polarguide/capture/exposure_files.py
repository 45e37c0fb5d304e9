"""Find the files of exposure brackets: several photographs of one shot at different exposures.

The end of a file name states the exposure in stops relative to the normal exposure (``cup_045_ev0.jpg``,
``cup_045_ev-3.jpg``), or numbers the exposures (``cup_045_bracket1.jpg``). The number follows ``bracket`` directly and
has one or two digits, because objects have names such as ``bracket_045``. The table ``exposures.csv`` in the folder of
the files states both for files with other names.

A *shot* is the light of one pose and one polarizer angle, or one mosaic. The file nearest to the normal exposure
represents the shot wherever one file is needed, for example to read headers.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from polarguide.capture.layout import ambiguous, list_files
from polarguide.core.errors import require
from polarguide.core.files import read_rows
from polarguide.core.options import LARGEST_STOPS
from polarguide.core.records import shortened
from polarguide.core.text import canonical, number_or_nan, stem_of

EXPOSURE_TABLE = "exposures.csv"
"""Name of the table of exposures."""
_COLUMNS = ["file", "shot", "stops"]
_REMEDY = "Use the columns file, shot and stops; stops may be empty if EXIF data or the pictures state the exposure."
_LABEL = re.compile(r"(?P<shot>.+?)[-_ .](?:ev ?(?P<stops>[+-]?\d+(?:\.\d+)?)|bracket\d{1,2})", re.IGNORECASE)


@dataclass(frozen=True)
class ExposureName:
    """Shot and exposure of a file.

    Attributes:
        shot: name of the shot, which all of its exposures share.
        stops: exposure in stops relative to the normal exposure; None if it is not stated.
    """

    shot: str
    stops: float | None = None


def exposure_name(path: Path) -> ExposureName:
    """Return the shot and the exposure of a file, from the table of its folder or from its name.

    Raises:
        PolarguideError: the table cannot be read, a cell is invalid, or a listed file is missing.
    """
    table = path.parent / EXPOSURE_TABLE
    if os.path.lexists(table):
        status = table.stat()
        # The time of the folder changes if a file is added or removed.
        key = (status.st_mtime_ns, status.st_size, path.parent.stat().st_mtime_ns)
        entry = _read_table(table, *key).get(canonical(path.name))
        if entry is not None:
            return entry
    stem = stem_of(path)
    match = _LABEL.fullmatch(stem)
    if match is None:
        return ExposureName(stem)
    stops = match["stops"]
    return ExposureName(match["shot"], None if stops is None else float(stops))


@lru_cache(maxsize=16)
def _read_table(table: Path, *_: int) -> dict[str, ExposureName]:
    """Read the shot and the exposure of each file that a table lists."""
    rows = read_rows(table, _REMEDY)
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    require(
        header == _COLUMNS,
        f"{table} (line 1)",
        expected=f"the header {','.join(_COLUMNS)}",
        found=shortened(",".join(header)) if header else "an empty file",
        remedy=_REMEDY,
    )
    existing = {canonical(path.name) for path in table.parent.iterdir()}
    entries: dict[str, ExposureName] = {}
    for number, row in rows[1:]:
        file, shot, text = (*row, "", "", "")[:3]
        stops = number_or_nan(text) if text else None
        valid = stops is None or abs(stops) <= LARGEST_STOPS
        require(
            len(row) in (2, 3) and file and shot and valid and canonical(file) not in entries,
            f"{table} (line {number})",
            expected=f"a file that is listed once, the name of its shot, and stops up to {LARGEST_STOPS:g}",
            found=shortened(",".join(row)),
            remedy=_REMEDY,
        )
        require(
            canonical(file) in existing,
            f"{table} (line {number})",
            expected=f"the file {table.parent / file}",
            found="nothing with this name",
            remedy="Correct the name, or remove the line.",
        )
        entries[canonical(file)] = ExposureName(canonical(shot), stops)
    return entries


def shot_stem(path: Path) -> str:
    """Return the name of a file without suffix and exposure, which is the name of its shot."""
    return exposure_name(path).shot


def list_shot_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return one file of each shot in a folder, sorted. A missing folder has no files."""
    return sorted(one_of_each_shot(list_files(folder, suffixes)))


def one_of_each_shot(files: Sequence[Path]) -> list[Path]:
    """Return one of the files of each shot: the file nearest to the normal exposure, or the first one.

    Files of one shot have the same folder and suffix. A file without a label is a shot of its own.
    """
    nearest: dict[object, tuple[float, Path]] = {}
    for path in files:
        name = exposure_name(path)
        stops = 0.0 if name.stops is None else abs(name.stops)
        key = (path.parent, name.shot, path.suffix.lower()) if _is_labeled(path) else path
        if key not in nearest or stops < nearest[key][0]:
            nearest[key] = stops, path
    return [path for _, path in nearest.values()]


def index_shot_files(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return one file of each shot in a folder by the name of the shot, like ``list_shot_files``.

    Raises:
        PolarguideError: files with two suffixes have the same name.
    """
    files: dict[str, Path] = {}
    for path in list_shot_files(folder, suffixes):
        shot = shot_stem(path)
        if shot in files:
            raise ambiguous(folder, f"one file called {shot}", files[shot], path)
        files[shot] = path
    return files


def _is_labeled(path: Path) -> bool:
    """Return True if the name of a file, or the table, labels it as one exposure of a shot."""
    return exposure_name(path) != ExposureName(stem_of(path))


def exposure_files(path: Path) -> tuple[Path, ...]:
    """Return all files of the shot that a file represents, sorted by name. A file without a label is alone."""
    if not _is_labeled(path):
        return (path,)
    shot = shot_stem(path)
    others = list_files(path.parent, (path.suffix.lower(),))
    return tuple(other for other in others if shot_stem(other) == shot)


def is_lone_exposure(path: Path) -> bool:
    """Return True if a file is labeled as an exposure, and its shot has no other exposure."""
    return _is_labeled(path) and len(exposure_files(path)) == 1


def all_exposures(paths: Sequence[Path]) -> list[Path]:
    """Return the files of all exposures of some shots."""
    return [file for path in paths for file in exposure_files(path)]


def exposure_tables(paths: Sequence[Path]) -> list[Path]:
    """Return the tables of exposures that exist in the folders of some files."""
    tables = (folder / EXPOSURE_TABLE for folder in dict.fromkeys(path.parent for path in paths))
    return [table for table in tables if os.path.lexists(table)]
