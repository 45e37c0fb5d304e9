"""Polarizer angle and gain of each picture of a view, read from file names or from a table."""

from __future__ import annotations

import itertools
import math
import os
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture.calibration import Calibration
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import read_rows, stored
from polarguide.core.records import shortened
from polarguide.core.text import canonical, csv_lines, decimal_comma, number_or_nan
from polarguide.geometry.polarizer import ANGLES
from polarguide.optics import Mount

Angle = float | Literal["unknown", "none"]
"""Polarizer angle in degrees counter-clockwise from the picture's horizontal, or a word.

"unknown" means a polarizer at an unknown angle, "none" means a picture without a polarizer.
"""
LARGEST = 3600.0
"""Largest absolute angle in degrees that is accepted."""


def parse_angle(text: str) -> Angle | None:
    """Parse an angle in degrees, "unknown" or "none". Return None for any other text."""
    word = text.strip().lower()
    words: dict[str, Angle] = {"unknown": "unknown", "none": "none"}
    if word in words:
        return words[word]
    number = number_or_nan(word)
    return number if abs(number) <= LARGEST else None


def turned(angle: Angle, calibration: Calibration) -> Angle:
    """Return the angle as displayed, ``sense * angle + zero`` in degrees, in [0, 180).

    ``calibration`` has the sense and the zero. The words "unknown" and "none" are returned unchanged.
    """
    if isinstance(angle, str):
        return angle
    sign = -1 if calibration.sense == "cw" else 1
    return round(sign * angle + calibration.zero, 6) % 180.0


def angle_text(angle: Angle) -> str:
    """Format an angle or word for a table of angles."""
    return angle if isinstance(angle, str) else f"{angle:.10g}"


def angle_labels(angles: Sequence[Angle]) -> list[str]:
    """Return a different label for each picture of a view, for file names.

    Labels are angles such as ``045`` and ``012.5``, or words. A repeated word gets a number, such as ``unknown-2``.
    """
    labels: list[str] = []
    for angle in angles:
        label = angle if isinstance(angle, str) else f"{angle % 180:06.2f}".rstrip("0").rstrip(".")
        same = sum(other == label or other.startswith(f"{label}-") for other in labels)
        labels.append(label if not same else f"{label}-{same + 1}")
    return labels


WELL_CONDITIONED = 0.15
"""Smallest ``conditioning`` of polarizer angles for which Stokes vectors are computed.

The angles 0, 45, 90 and 135 degrees have a conditioning of 0.71.
"""
BALANCED = 0.05
"""Largest length of the mean analyzer for which the mean intensity counts as ``S0 / 2``.

Two pictures at a right angle have this length if the angle is off by about 3 degrees.
"""


@dataclass(frozen=True)
class Exposure:
    """Polarizer angle and gain of one picture of a view.

    Attributes:
        angle: angle of the polarizer in degrees, in [0, 180). It is ``None`` if the angle is unknown, or if there is no
            polarizer.
        filtered: True if a polarizer was in front of the lens or the sensor.
        gain: brightness of the exposure relative to the other pictures of the scene. Pixel values are divided by it.
    """

    angle: float | None = None
    filtered: bool = True
    gain: float = 1.0

    @property
    def known(self) -> bool:
        """True if the angle of the polarizer is known, or if there is no polarizer."""
        return self.angle is not None or not self.filtered

    @property
    def label(self) -> str:
        """Text for messages."""
        return "no filter" if not self.filtered else "unknown" if self.angle is None else f"{self.angle:g}"


FOUR = tuple(Exposure(float(angle)) for angle in ANGLES)
"""Exposures of a polarization camera at 0, 45, 90 and 135 degrees with gain 1."""
PLAIN = (Exposure(filtered=False),)
"""Exposures of a view with one photograph without a polarizer."""


def nominal(exposures: Sequence[Exposure]) -> Tensor:
    """Return ``(cos 2t, sin 2t)`` of the polarizer angle t of each exposure, [K, 2] float64.

    The pair is (0, 0) for a picture without a filter. All angles must be known.
    """
    axis = torch.zeros(1, 3, dtype=torch.float64)
    none = torch.zeros(2, dtype=torch.float64)
    cosines = [none if e.angle is None else optics.analyzer(math.radians(e.angle), axis) for e in exposures]
    return torch.stack(cosines) if cosines else torch.zeros(0, 2, dtype=torch.float64)


def analyzers(exposures: Sequence[Exposure], rays: Tensor, mount: Mount) -> Tensor:
    """Return ``(cos 2t, sin 2t)`` of the effective polarizer angle t of each exposure.

    The effective angle behind a filter in front of the lens depends on the pixel.

    Args:
        exposures: exposures with known angles.
        rays: unit rays of the pixels in camera axes, [H, W, 3].
        mount: place of the polarizer.

    Returns:
        [K, 2] for a polarizer on the sensor, [K, 2, H, W] for a filter in front of the lens.
    """
    if mount == "sensor":
        return nominal(exposures).to(rays)
    none = torch.zeros_like(rays[..., :2]).movedim(-1, 0)
    return torch.stack(
        [none if e.angle is None else optics.filter_analyzer(math.radians(e.angle), rays) for e in exposures]
    )


def conditioning(analyzers: Tensor) -> float:
    """Measure how well polarizer angles determine a Stokes vector.

    The result is the ratio of the smallest to the largest singular value of the matrix with a row
    ``(1, cos 2t, sin 2t)`` for each angle t. It is 0.71 for evenly spread angles, and 0 for angles that do not
    determine a Stokes vector.

    Args:
        analyzers: ``(cos 2t, sin 2t)`` of each angle, [K, 2].
    """
    if len(analyzers) < 3:
        return 0.0
    rows = torch.cat((torch.ones_like(analyzers[:, :1]), analyzers), dim=1)
    values = torch.linalg.svdvals(rows.double())
    return float(values[-1] / values[0])


def determine_stokes(exposures: Sequence[Exposure]) -> bool:
    """Return True if the exposures with known angles determine Stokes vectors, see ``WELL_CONDITIONED``."""
    return conditioning(nominal([e for e in exposures if e.known])) >= WELL_CONDITIONED


def radiance_places(exposures: Sequence[Exposure]) -> tuple[int, ...]:
    """Return the indices of the exposures whose mean is ``S0 / 2``.

    If there are exposures without a filter, return their indices. Otherwise return the indices of all exposures with
    known angles, if their mean is ``S0 / 2`` for any polarization (see ``BALANCED``). Otherwise return no index.
    """
    plain = tuple(k for k, e in enumerate(exposures) if not e.filtered)
    if plain:
        return plain
    known = tuple(k for k, e in enumerate(exposures) if e.known)
    mean = nominal([exposures[k] for k in known]).mean(dim=0) if known else None
    return known if mean is not None and float(mean.norm()) < BALANCED else ()


def normalized(angle: float) -> float:
    """Return an angle in degrees modulo 180, in [0, 180)."""
    remainder = angle % 180.0
    return 0.0 if remainder == 180.0 else remainder  # tiny negative angles round to 180


TABLE = "angles.csv"
_COLUMNS = ("file", "view", "angle", "gain", "modulation", "note")
_NEEDED = ("file", "angle")
# Columns that a training writes for the user. A reader ignores them.
_WRITTEN_BY_TRAINING = ("modulation", "note")
# Cameras cover about twenty stops. Larger gains overflow single precision.
_LARGEST_GAIN = 1e6
_REMEDY = "Use the columns file, angle (degrees, unknown or none) and optionally view and gain, separated by commas."


@dataclass(frozen=True)
class Line:
    """One line of the table of angles, ``angles.csv``.

    Attributes:
        number: number of the line; the first line of the file is 1.
        file: normalized name of the picture, relative to ``polar/`` of a scene or to the folder of the photographs.
        view: name of the picture's view. All pictures of a view share a pose. If it is ``None``, the view has only this
            picture and the name of the file without suffix.
        angle: angle of the polarizer.
        gain: exposure relative to the other pictures; None if the cell is empty.
    """

    number: int
    file: str
    view: str | None
    angle: Angle
    gain: float | None

    @property
    def exposure(self) -> Exposure:
        """Exposure with the angle and gain of the line. The gain is 1 if its cell is empty."""
        gain = 1.0 if self.gain is None else self.gain
        if isinstance(self.angle, str):
            return Exposure(filtered=self.angle == "unknown", gain=gain)
        return Exposure(normalized(self.angle), gain=gain)


def read_table(path: Path) -> list[Line]:
    """Read the lines of a table of angles. A line may omit empty cells at its end.

    Raises:
        PolarguideError: the table cannot be read, a column is missing or unknown, a file is listed twice, or an angle
            or gain is invalid. The message names the line.
    """
    rows = read_rows(path, _REMEDY)
    columns = _header(path, rows[0][1] if rows else [])
    lines: dict[str, Line] = {}
    for number, row in rows[1:]:
        where = f"{path} (line {number})"
        if not len(_NEEDED) <= len(row) <= len(columns):
            cells = f"{len(row)}: {shortened(','.join(row))}"
            if len(row) > len(columns) and decimal_comma(map(",".join, itertools.pairwise(row))):
                cells += ", which may be a decimal comma"
            raise PolarguideError(where, expected=f"{len(columns)} cells", found=cells, remedy=_REMEDY)
        line = _line(where, number, dict(zip(columns, row, strict=False)))
        if line.file in lines:
            raise _listed_twice(where, lines[line.file], line)
        lines[line.file] = line
    return list(lines.values())


def files_of(root: Path, table: Path, lines: Sequence[Line]) -> list[Path]:
    """Return the path of each line's picture, spelled like the file on disk. A file may be missing.

    Raises:
        PolarguideError: two lines name the same file.
    """
    files = [stored(root / line.file) for line in lines]
    first: dict[str, Line] = {}
    for line, path in zip(lines, files, strict=True):
        before = first.setdefault(os.path.realpath(path), line)
        if before is not line:
            raise _listed_twice(f"{table} (line {line.number})", before, line)
    return files


def _listed_twice(where: str, first: Line, second: Line) -> PolarguideError:
    names = " and ".join(dict.fromkeys((first.file, second.file)))
    return PolarguideError(
        where,
        expected="one line for each file",
        found=f"two for {names}, lines {first.number} and {second.number}",
        remedy="Remove one of the lines.",
    )


def _header(path: Path, row: list[str]) -> list[str]:
    columns = [cell.lower() for cell in row]
    known = set(columns) <= {*_COLUMNS, *_WRITTEN_BY_TRAINING} and len(set(columns)) == len(columns)
    require(
        known and set(_NEEDED) <= set(columns),
        f"{path} (line 1)",
        expected="the header file,angle or file,view,angle,gain",
        found=shortened(",".join(row)) if row else "an empty file",
        remedy=_REMEDY,
    )
    return columns


def _line(where: str, number: int, cells: Mapping[str, str]) -> Line:
    """Create a line from the text of its cells by column."""
    file = cells["file"]
    require(
        file,
        where,
        expected="the name of a file",
        found="an empty cell",
        remedy=_REMEDY,
    )
    angle = parse_angle(cells.get("angle", ""))
    if angle is None:
        raise PolarguideError(
            f"{where}, {file}",
            expected=f"an angle in degrees up to {LARGEST:g}, unknown or none",
            found=_cell(cells.get("angle", "")),
            remedy="Write unknown for an angle that was not noted, and none for a picture without a filter.",
        )
    gain = number_or_nan(cells["gain"]) if cells.get("gain") else None
    require(
        gain is None or 1 / _LARGEST_GAIN <= gain <= _LARGEST_GAIN,
        f"{where}, {file}",
        expected=f"a gain from {1 / _LARGEST_GAIN:g} to {_LARGEST_GAIN:g}, or an empty cell",
        found=_cell(cells.get("gain", "")),
        remedy="Leave the cell empty if the gain is unknown.",
    )
    return Line(
        number, posixpath.normpath(canonical(file)), canonical(cells.get("view", "")) or None, angle, gain
    )


def _cell(text: str) -> str:
    """Format a cell with an invalid number for an error message."""
    comma = decimal_comma([text])
    return f"{comma} with a decimal comma; numbers have a point" if comma else shortened(text)


def table_text(lines: Iterable[tuple[str, str, Exposure, float | None, str]]) -> str:
    """Format a table of angles as CSV text.

    Args:
        lines: tuple of file, view, exposure, modulation and note for each picture. The modulation (see
            ``FittedAngle``) is ``None`` if it was not fitted.
    """
    rows: list[list[object]] = [[*_COLUMNS]]
    for file, view, exposure, modulation, note in lines:
        known = "unknown" if exposure.angle is None else f"{exposure.angle:.2f}"
        angle = known if exposure.filtered else "none"
        strength = None if modulation is None else f"{modulation:.2f}"
        rows.append([file, view, angle, f"{exposure.gain:.4f}", strength, note])
    return csv_lines(rows)


FEWEST = 3
"""Smallest number of different angles that determine a Stokes vector."""
NAMING = (
    "Name files like cup_045.jpg, cup_a30.jpg, cup_unknown.jpg or cup_none.jpg (numbers without a letter must be "
    "multiples of 15 or evenly spaced over half a turn); or write angles.csv with the columns file,angle; or use "
    "--angles unknown."
)
_WORDS = "unknown|none"
_NUMBER = r"(?P<mark>angle|pol|a|i)?[-_ ]?(?P<angle>\d{1,3}(?:\.\d+)?)(?P<unit>deg)?"
# A hyphen before a number is a minus only after another separator: cup_-45 means -45, cup-45 means 45.
_APART = r"(?:[-_ .]*[_ .](?P<minus>-)(?=\d)|[-_ .]+)"
_MARK = r"(?:(?:angle|pol|a|i)[-_ ]?)?"
_SINGLE = re.compile(rf"(?P<view>.+?){_APART}(?:{_NUMBER}|{_MARK}(?P<word>{_WORDS}))", re.IGNORECASE)
# Degrees between the marks on the ring of a filter. A number that is no multiple of it may count pictures, so it is an
# angle only with a letter or a unit.
_MARKS = 15
_NUMBERED = re.compile(
    rf"(?:(?P<view>.+?){_APART}{_MARK}|(?P<alone>-))?(?P<number>\d{{1,3}}(?:\.\d+)?)", re.IGNORECASE
)
_SMALLEST_STEP = 2.0
"""Smallest step of evenly spaced angles in degrees. Numbers with a smaller step may count pictures."""
_ALIKE = 1e-6


def folders_of_angles(root: Path) -> dict[Path, Angle]:
    """Return the angle of each subfolder whose name is an angle, sorted by name."""
    folders = [path for path in sorted(root.iterdir()) if path.is_dir()]
    names = angles_of_names([path.name for path in folders], folders=True)
    return {
        path: name[1] for path, name in zip(folders, names, strict=True) if name is not None and not name[0]
    }


def angles_of_names(names: Sequence[str], *, folders: bool = False) -> list[tuple[str, Angle] | None]:
    """Split each name into view and angle. The result is ``None`` for a name without an angle.

    A number is an angle if it has a letter or a unit, or if it is a multiple of 15 that is less than 180. Other numbers
    are angles if all numbers of a view are evenly spaced over a half or a full turn, such as 10, 40, ..., 160. If a
    name consists of an angle only, its view is "".

    Args:
        names: file names without suffix, or names of folders.
        folders: True if the names are those of folders. The name I_10 is then the angle 10 without a view, and not the
            angle 10 of a view I.
    """
    stated = [_stated(name, folders) for name in names]
    numbered: dict[str, list[tuple[int, float]]] = {}
    for place, name in enumerate(names):
        match = _NUMBERED.fullmatch(name)
        if match is not None:
            sign = -1 if match["minus"] or match["alone"] else 1
            numbered.setdefault(match["view"] or "", []).append((place, sign * float(match["number"])))
    for view, places in numbered.items():
        if covers_turn([number for _, number in places]):
            for place, number in places:
                if not folders or stated[place] is None:
                    stated[place] = view, number
    return stated


def _stated(name: str, folder: bool) -> tuple[str, Angle] | None:
    """Return the view and the angle in the name of a picture or a folder, or None."""
    parts = None if folder else split_name(name)
    if parts is None and (alone := split_name(f"x_{name}")) is not None and alone[0] == "x":
        return "", alone[1]
    return parts


def covers_turn(angles: Sequence[float]) -> bool:
    """Return True if angles in degrees are evenly spaced over a half or a full turn.

    The last angle may repeat the first one, such as 180 after 0.
    """
    different = sorted(set(angles))
    if len(different) < FEWEST:
        return False
    steps = [b - a for a, b in itertools.pairwise(different)]
    step = steps[0]
    count = len(different)
    even = step >= _SMALLEST_STEP and all(abs(other - step) < _ALIKE for other in steps)
    return even and any(abs(span - turn) < _ALIKE for span in (step * count, step * (count - 1))
                        for turn in (180.0, 360.0))  # fmt: skip


def split_name(stem: str) -> tuple[str, Angle] | None:
    """Split a file name into view and angle. Return None if it has no angle."""
    match = _SINGLE.fullmatch(stem)
    angle = None if match is None else _angle_of(match)
    return None if match is None or angle is None else (match["view"], angle)


def _angle_of(match: re.Match[str]) -> Angle | None:
    """Return the angle of a matched name. Return None if its number may count pictures instead."""
    if match["word"]:
        return parse_angle(match["word"])
    number = -float(match["angle"]) if match["minus"] else float(match["angle"])
    certain = match["mark"] or match["unit"] or (number % _MARKS == 0 and number < 180)
    return number if certain and abs(number) <= 360 else None
