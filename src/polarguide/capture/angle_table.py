"""``angles.csv``: which picture of ``polar/`` belongs to which view, and what was before the lens."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.exposures import Exposure, normalized
from polarguide.errors import PolarguideError
from polarguide.files import read_file
from polarguide.numerals import decimal
from polarguide.spreadsheet import csv_lines

TABLE = "angles.csv"
UNKNOWN, NONE = "unknown", "none"
_COLUMNS = ("file", "view", "angle")
_MORE = ("gain", "modulation", "note")
"""Further columns; the last two are what a training says of its pictures, and are passed over."""
_EARLIER = "certainty"
"""What runs of earlier versions call the modulation; their tables stay in use."""
_LARGEST = 1 << 26
_LEAST_GAIN = 1e-6
"""A camera exposes over some thirty stops; less leaves no numbers in single precision."""
_REMEDY = f"Correct the line: file,view,angle[,gain] with the angle in degrees, {UNKNOWN} or {NONE}."


@dataclass(frozen=True)
class Listed:
    """A line of the table.

    Attributes:
        line: its number, from 1. file: name inside ``polar/``. view: name of the view. exposure: what it says.
    """

    line: int
    file: str
    view: str
    exposure: Exposure


def read_table(path: Path, data: bytes | None = None) -> list[Listed]:
    """The lines of a table, in their order.

    Args:
        path: of the table, for messages. data: its content; None: it is read.

    Raises:
        PolarguideError: a line is not as it should be, or a file has two; the message has its number.
    """
    data = read_file(path, largest=_LARGEST, remedy=_REMEDY) if data is None else data
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise PolarguideError(
            path, expected="text in UTF-8", found=str(error), remedy="Save the table anew."
        ) from None
    rows = csv.reader(text.splitlines(), skipinitialspace=True)
    try:
        cells = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except csv.Error as error:
        raise PolarguideError(
            f"{path} (line {rows.line_num})", expected="CSV", found=str(error), remedy=_REMEDY
        ) from None
    cells = [(line, row) for line, row in cells if any(row)]
    columns = _header(path, cells[0][1] if cells else [])
    lines: dict[str, Listed] = {}
    for line, row in cells[1:]:
        item = _listed(f"{path} (line {line})", line, row, columns)
        if item.file in lines:
            raise PolarguideError(
                f"{path} (line {line})",
                expected="one line for each file",
                found=f"{item.file}, which line {lines[item.file].line} has, too",
                remedy="Remove one of them.",
            )
        lines[item.file] = item
    return list(lines.values())


def _header(path: Path, row: list[str]) -> list[str]:
    named = [cell.lower() for cell in row]
    wrong = [name for name in named if name not in (*_COLUMNS, *_MORE, _EARLIER)]
    if wrong or not set(_COLUMNS) <= set(named) or len(set(named)) < len(named):
        raise PolarguideError(
            f"{path} (line 1)",
            expected="the header file,view,angle or file,view,angle,gain",
            found=",".join(row)[:100] or "an empty table",
            remedy="Write that as the first line.",
        )
    return named


def _listed(where: str, line: int, row: list[str], columns: list[str]) -> Listed:
    if len(row) > len(columns) or len(row) < len(_COLUMNS):
        raise PolarguideError(
            where,
            expected=f"{len(columns)} cells, {','.join(columns)}",
            found=f"{len(row)}: {','.join(row)[:100]}",
            remedy=_REMEDY,
        )
    cells = dict(zip(columns, row, strict=False))
    for name in ("file", "view"):
        if not cells.get(name) or (name == "file" and _is_path(cells[name])):
            expected = "the name of a picture inside polar/" if name == "file" else "the name of a view"
            raise PolarguideError(where, expected=expected, found=repr(cells.get(name, "")), remedy=_REMEDY)
    angle = cells.get("angle", "")
    gain = _number(where, "gain", cells.get("gain") or "1", least=_LEAST_GAIN)
    if angle.lower() in (UNKNOWN, NONE):
        exposure = Exposure(filtered=angle.lower() == UNKNOWN, gain=gain)
    else:
        exposure = Exposure(normalized(_number(where, "angle", angle)), gain=gain)
    return Listed(line, cells["file"], cells["view"], exposure)


def _is_path(name: str) -> bool:
    return "/" in name or "\\" in name or name in (".", "..") or "\0" in name


def _number(where: str, name: str, text: str, least: float = -math.inf) -> float:
    words = f", {UNKNOWN} or {NONE}" if name == "angle" else ""
    expected = "a positive number" if math.isfinite(least) else "a number of degrees"
    try:
        value = decimal(text)
    except ValueError:
        value = math.nan
    small = f"{value:g}, less than {least:g}" if 0 < value < least else ""
    if not math.isfinite(value) or value < least or abs(value) > 1e6:
        raise PolarguideError(
            where, expected=f"{expected}{words} as {name}", found=small or repr(text), remedy=_REMEDY
        )
    return value


def table_text(lines: Iterable[tuple[str, str, Exposure, float | None, str]]) -> str:
    """A table as CSV text: file, view, exposure, modulation as of ``FittedAngle`` (None: not fitted), and a note."""
    rows: list[list[object]] = [[*_COLUMNS, *_MORE]]
    for file, view, exposure, modulation, note in lines:
        angle = (
            NONE if not exposure.filtered else UNKNOWN if exposure.angle is None else f"{exposure.angle:.2f}"
        )
        shown = None if modulation is None else f"{modulation:.2f}"
        rows.append([file, view, angle, f"{exposure.gain:.4f}", shown, note])
    return csv_lines(rows)
