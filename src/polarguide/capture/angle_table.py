"""``angles.csv``: the polarizer angle of each picture of a scene, or of each photograph that is to be prepared."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.exposures import Exposure, normalized
from polarguide.capture.polarizer_angles import LARGEST, Angle, parse_angle
from polarguide.errors import PolarguideError
from polarguide.files import read_file
from polarguide.records import shortened
from polarguide.spreadsheet import csv_lines
from polarguide.text import decimal

TABLE = "angles.csv"
_COLUMNS = ("file", "view", "angle", "gain", "modulation", "note")
_NEEDED = ("file", "angle")
_WRITTEN_BY_TRAINING = ("modulation", "note", "certainty")
"""Columns that a training writes, and that are not read; ``certainty`` in earlier versions."""
_LARGEST_TABLE = 1 << 26
_LARGEST_GAIN = 1e6
"""A camera exposes over some twenty stops either way; more leaves no numbers in single precision."""
_REMEDY = "Columns are file, angle (degrees, unknown or none) and, where wanted, view and gain, with commas between."


@dataclass(frozen=True)
class Line:
    """A line of the table.

    Attributes:
        number: of the line, from 1.
        file: the picture's name: inside ``polar/`` of a scene, else relative to the folder of the photographs.
        view: pictures of one view share their pose; None for a view of its own, called like the file without suffix.
        angle: of the polarizer.
        gain: exposure relative to the other pictures; None if it is not given.
    """

    number: int
    file: str
    view: str | None
    angle: Angle
    gain: float | None

    @property
    def exposure(self) -> Exposure:
        """The exposure; its gain is 1 if it is not given."""
        gain = 1.0 if self.gain is None else self.gain
        if isinstance(self.angle, str):
            return Exposure(filtered=self.angle == "unknown", gain=gain)
        return Exposure(normalized(self.angle), gain=gain)


def read_table(path: Path) -> list[Line]:
    """The lines of a table, in their order. Empty cells at the end of a line may be left out.

    Raises:
        PolarguideError: it cannot be read, a column is missing or unknown, a file is listed twice, or an angle or a
            gain is not a number; the message has the line.
    """
    data = read_file(path, largest=_LARGEST_TABLE, remedy=_REMEDY)
    try:
        text = io.StringIO(data.decode("utf-8-sig"), newline="")
        reader = csv.reader(text, strict=True, skipinitialspace=True)
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise PolarguideError(
            path, expected="CSV text in UTF-8", found=f"something else ({error})", remedy=_REMEDY
        ) from None
    rows = [(number, row) for number, row in rows if any(row)]
    columns = _header(path, rows[0][1] if rows else [])
    lines: dict[str, Line] = {}
    for number, row in rows[1:]:
        where = f"{path} (line {number})"
        if not len(_NEEDED) <= len(row) <= len(columns):
            found = f"{len(row)}: {shortened(','.join(row))}"
            raise PolarguideError(where, expected=f"{len(columns)} cells", found=found, remedy=_REMEDY)
        line = _line(where, number, dict(zip(columns, row, strict=False)))
        if line.file in lines:
            raise PolarguideError(
                where,
                expected="one line for each file",
                found=f"two for {line.file}, lines {lines[line.file].number} and {number}",
                remedy="Remove one of them.",
            )
        lines[line.file] = line
    return list(lines.values())


def _header(path: Path, row: list[str]) -> list[str]:
    columns = [cell.lower() for cell in row]
    known = set(columns) <= {*_COLUMNS, *_WRITTEN_BY_TRAINING} and len(set(columns)) == len(columns)
    if not known or not set(_NEEDED) <= set(columns):
        raise PolarguideError(
            f"{path} (line 1)",
            expected="the header file,angle or file,view,angle,gain",
            found=shortened(",".join(row)) if row else "an empty file",
            remedy=_REMEDY,
        )
    return columns


def _line(where: str, number: int, cells: Mapping[str, str]) -> Line:
    """One line from its cells by column."""
    file = cells["file"]
    if not file or "\0" in file:
        found = shortened(file) if file else "an empty cell"
        raise PolarguideError(where, expected="the name of a file", found=found, remedy=_REMEDY)
    angle = parse_angle(cells.get("angle", ""))
    if angle is None:
        raise PolarguideError(
            f"{where}, {file}",
            expected=f"an angle in degrees up to {LARGEST:g}, unknown or none",
            found=shortened(cells.get("angle", "")),
            remedy="Write unknown where the angle was not noted, none where there was no filter.",
        )
    gain = _number(cells["gain"]) if cells.get("gain") else None
    if gain is not None and not 1 / _LARGEST_GAIN <= gain <= _LARGEST_GAIN:
        raise PolarguideError(
            f"{where}, {file}",
            expected=f"a gain from {1 / _LARGEST_GAIN:g} to {_LARGEST_GAIN:g}, or an empty cell",
            found=shortened(cells["gain"]),
            remedy="Leave it empty if it is not known.",
        )
    return Line(number, file, cells.get("view") or None, angle, gain)


def _number(text: str) -> float:
    try:
        return decimal(text)
    except ValueError:
        return math.nan


def table_text(lines: Iterable[tuple[str, str, Exposure, float | None, str]]) -> str:
    """A table as CSV text: file, view, exposure, modulation as of ``FittedAngle`` (None: not fitted), and a note."""
    rows: list[list[object]] = [[*_COLUMNS]]
    for file, view, exposure, modulation, note in lines:
        known = "unknown" if exposure.angle is None else f"{exposure.angle:.2f}"
        shown = None if modulation is None else f"{modulation:.2f}"
        rows.append([file, view, known if exposure.filtered else "none", f"{exposure.gain:.4f}", shown, note])
    return csv_lines(rows)
