"""The table that says which polarizer angle each photograph was taken at: ``angles.csv``."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.polarizer_angles import LARGEST, Angle, parse_angle
from polarguide.errors import PolarguideError
from polarguide.files import read_file
from polarguide.numerals import decimal
from polarguide.records import shortened

TABLE = "angles.csv"
COLUMNS = ("file", "angle", "view", "gain")
_REMEDY = "Columns are file, angle (degrees, unknown or none) and, where wanted, view and gain, with commas between."
_LARGEST_TABLE = 1 << 24
_LARGEST_GAIN = 1e4


@dataclass(frozen=True)
class Line:
    """A line of the table.

    Attributes:
        file: the photograph's name, relative to the folder of the table.
        angle: of the polarizer, as the user counts.
        view: photographs of one view share their pose; None for a photograph of its own.
        gain: exposure relative to the other photographs; None to estimate it.
    """

    file: str
    angle: Angle
    view: str | None
    gain: float | None


def read_angle_table(path: Path) -> list[Line]:
    """The lines of a table, in its order.

    Raises:
        PolarguideError: it cannot be read, a column is missing or strange, a file is listed twice, an angle or a gain
            is no number.
    """
    data = read_file(path, largest=_LARGEST_TABLE)
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise PolarguideError(
            path, expected="CSV text in UTF-8", found=f"something else ({error})", remedy=_REMEDY
        ) from None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    known = set(header) <= set(COLUMNS) and len(set(header)) == len(header)
    if not known or not {"file", "angle"} <= set(header):
        found = shortened(",".join(rows[0])) if rows else "an empty file"
        raise PolarguideError(path, expected="the header file,angle", found=found, remedy=_REMEDY)
    lines: list[Line] = []
    places: dict[str, int] = {}
    for number, cells in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        where = f"{path} (line {number})"
        if len(cells) != len(header):
            found = f"{len(cells)}: {shortened(','.join(cells))}"
            raise PolarguideError(where, expected=f"{len(header)} cells", found=found, remedy=_REMEDY)
        line = _line(where, {name: cell.strip() for name, cell in zip(header, cells, strict=True)})
        if line.file in places:
            raise PolarguideError(
                path,
                expected="one line for each file",
                found=f"two for {line.file}, lines {places[line.file]} and {number}",
                remedy="Remove one of them.",
            )
        places[line.file] = number
        lines.append(line)
    return lines


def _line(where: str, cells: dict[str, str]) -> Line:
    """One line from its cells by column."""
    if not cells["file"]:
        raise PolarguideError(where, expected="the name of a file", found="an empty cell", remedy=_REMEDY)
    angle = parse_angle(cells["angle"])
    if angle is None:
        raise PolarguideError(
            f"{where}, {cells['file']}",
            expected=f"an angle in degrees up to {LARGEST:g}, unknown or none",
            found=shortened(cells["angle"]),
            remedy="Write unknown where the angle was not noted, none where there was no filter.",
        )
    gain = None
    if cells.get("gain"):
        gain = _number(cells["gain"])
        if gain is None or not 1 / _LARGEST_GAIN <= gain <= _LARGEST_GAIN:
            raise PolarguideError(
                f"{where}, {cells['file']}",
                expected=f"a gain from {1 / _LARGEST_GAIN:g} to {_LARGEST_GAIN:g}, or an empty cell",
                found=shortened(cells["gain"]),
                remedy="Leave it empty to have it estimated.",
            )
    return Line(cells["file"], angle, cells.get("view") or None, gain)


def _number(text: str) -> float | None:
    try:
        value = decimal(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
