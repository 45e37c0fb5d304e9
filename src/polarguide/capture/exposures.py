"""Exposures of views: angle of the polarizer, presence of a polarizer, and gain, read from file names and tables."""

from __future__ import annotations

import itertools
import math
import os
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture.calibration import Calibration
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_rows, stored
from polarguide.core.records import shortened
from polarguide.core.text import canonical, csv_lines, decimal_comma, number_or_nan
from polarguide.geometry.polarizer import ANGLES
from polarguide.optics import Mount

Angle = float | Literal["unknown", "none"]
"""Degrees counter-clockwise from the picture's horizontal, modulo 180; or a word."""
LARGEST = 3600.0
"""Largest absolute angle in degrees that is accepted."""


def parse_angle(text: str) -> Angle | None:
    """Parse an angle or one of the two words; None for other texts."""
    word = text.strip().lower()
    words: dict[str, Angle] = {"unknown": "unknown", "none": "none"}
    if word in words:
        return words[word]
    number = number_or_nan(word)
    return number if abs(number) <= LARGEST else None


def turned(angle: Angle, calibration: Calibration) -> Angle:
    """Apply sense and zero of a calibration to an angle: ``sense * angle + zero`` in degrees, in [0, 180)."""
    if isinstance(angle, str):
        return angle
    sign = -1 if calibration.sense == "cw" else 1
    return round(sign * angle + calibration.zero, 6) % 180.0


def angle_text(angle: Angle) -> str:
    """Return an angle as text for tables."""
    return angle if isinstance(angle, str) else f"{angle:.10g}"


def angle_labels(angles: Sequence[Angle]) -> list[str]:
    """Return labels of the pictures of a view for file names: 045, 012.5, unknown, none, unknown-2, ..."""
    labels: list[str] = []
    for angle in angles:
        label = angle if isinstance(angle, str) else f"{angle % 180:06.2f}".rstrip("0").rstrip(".")
        same = sum(other == label or other.startswith(f"{label}-") for other in labels)
        labels.append(label if not same else f"{label}-{same + 1}")
    return labels


WELL_CONDITIONED = 0.15
"""Smallest ``conditioning`` of analyzers for which Stokes vectors are computed; 0/45/90/135 have 0.71."""
BALANCED = 0.05
"""Largest length of the mean analyzer for which the mean intensity is S0/2: a right angle set to 1.4 degrees."""


@dataclass(frozen=True)
class Exposure:
    """One picture of a view.

    Attributes:
        angle: angle of the polarizer in degrees, in [0, 180); None without a polarizer or for an unknown angle.
        filtered: True with a polarizer in front of the lens or the sensor.
        gain: exposure relative to the other pictures of the scene. Values are divided by it.
    """

    angle: float | None = None
    filtered: bool = True
    gain: float = 1.0

    @property
    def known(self) -> bool:
        """True if the picture has a known angle or no polarizer."""
        return self.angle is not None or not self.filtered

    @property
    def label(self) -> str:
        """Text for messages."""
        return "no filter" if not self.filtered else "unknown" if self.angle is None else f"{self.angle:g}"


FOUR = tuple(Exposure(float(angle)) for angle in ANGLES)
"""Exposures of a view of a polarization camera."""
PLAIN = (Exposure(filtered=False),)
"""Exposures of an ordinary photograph."""


def nominal(exposures: Sequence[Exposure]) -> Tensor:
    """Return the analyzers [K, 2] of known exposures on the optical axis, float64; (0, 0) without a filter."""
    axis = torch.zeros(1, 3, dtype=torch.float64)
    none = torch.zeros(2, dtype=torch.float64)
    cosines = [none if e.angle is None else optics.analyzer(math.radians(e.angle), axis) for e in exposures]
    return torch.stack(cosines) if cosines else torch.zeros(0, 2, dtype=torch.float64)


def analyzers(exposures: Sequence[Exposure], rays: Tensor, mount: Mount) -> Tensor:
    """Return the analyzers of known exposures: [K, 2], or [K, 2, H, W] for a filter in front of the lens.

    Args:
        exposures: known exposures.
        rays: unit rays [H, W, 3] in camera axes.
        mount: place of the polarizer.
    """
    if mount == "sensor":
        return nominal(exposures).to(rays)
    none = torch.zeros_like(rays[..., :2]).movedim(-1, 0)
    return torch.stack(
        [none if e.angle is None else optics.filter_analyzer(math.radians(e.angle), rays) for e in exposures]
    )


def conditioning(analyzers: Tensor) -> float:
    """Return the smallest over the largest singular value of the rows (1, cos 2t, sin 2t).

    Evenly spread angles have 0.71. Angles that do not determine a Stokes vector have 0.

    Args:
        analyzers: pairs (cos 2t, sin 2t), [K, 2].
    """
    if len(analyzers) < 3:
        return 0.0
    rows = torch.cat((torch.ones_like(analyzers[:, :1]), analyzers), dim=1)
    values = torch.linalg.svdvals(rows.double())
    return float(values[-1] / values[0])


def determine_stokes(exposures: Sequence[Exposure]) -> bool:
    """Return True if the known exposures determine a well-conditioned Stokes vector at every pixel."""
    return conditioning(nominal([e for e in exposures if e.known])) >= WELL_CONDITIONED


def measure_radiance(exposures: Sequence[Exposure]) -> bool:
    """Return True if S0 is measured: without a filter, by a pair at right angles, or by a full Stokes vector."""
    return determine_stokes(exposures) or bool(radiance_places(exposures))


def radiance_places(exposures: Sequence[Exposure]) -> tuple[int, ...]:
    """Return the indices of the exposures whose mean is S0/2.

    These are the exposures without a filter, else all known ones if they are balanced, else none.
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


def with_estimate(exposure: Exposure, angle: float, gain: float) -> Exposure:
    """Return an exposure with an estimated angle in degrees and gain."""
    return replace(exposure, angle=normalized(angle), gain=gain)


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
    """One line of the table of angles.

    Attributes:
        number: line number, from 1.
        file: normalized name of the picture: in ``polar/`` of a scene, else relative to the folder of photographs.
        view: view of the picture; None for a view of its own, named like the file without suffix. All pictures of a
            view share a pose.
        angle: angle of the polarizer.
        gain: exposure relative to the other pictures; None for an empty cell.
    """

    number: int
    file: str
    view: str | None
    angle: Angle
    gain: float | None

    @property
    def exposure(self) -> Exposure:
        """The exposure, with a gain of 1 for an empty cell."""
        gain = 1.0 if self.gain is None else self.gain
        if isinstance(self.angle, str):
            return Exposure(filtered=self.angle == "unknown", gain=gain)
        return Exposure(normalized(self.angle), gain=gain)


def read_table(path: Path) -> list[Line]:
    """Return the lines of a table in their order. Empty cells at the end of a line may be missing.

    Raises:
        PolarguideError: the table cannot be read, a column is missing or unknown, a file is listed twice, or an angle
            or gain is invalid. The error names the line.
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
    """Return the path of each line as the file system spells it. The files need not exist.

    Raises:
        PolarguideError: two lines name one file.
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
    if not known or not set(_NEEDED) <= set(columns):
        raise PolarguideError(
            f"{path} (line 1)",
            expected="the header file,angle or file,view,angle,gain",
            found=shortened(",".join(row)) if row else "an empty file",
            remedy=_REMEDY,
        )
    return columns


def _line(where: str, number: int, cells: Mapping[str, str]) -> Line:
    """Parse a line from its cells by column."""
    file = cells["file"]
    if not file:
        raise PolarguideError(where, expected="the name of a file", found="an empty cell", remedy=_REMEDY)
    angle = parse_angle(cells.get("angle", ""))
    if angle is None:
        raise PolarguideError(
            f"{where}, {file}",
            expected=f"an angle in degrees up to {LARGEST:g}, unknown or none",
            found=_cell(cells.get("angle", "")),
            remedy="Write unknown for an angle that was not noted, and none for a picture without a filter.",
        )
    gain = number_or_nan(cells["gain"]) if cells.get("gain") else None
    if gain is not None and not 1 / _LARGEST_GAIN <= gain <= _LARGEST_GAIN:
        raise PolarguideError(
            f"{where}, {file}",
            expected=f"a gain from {1 / _LARGEST_GAIN:g} to {_LARGEST_GAIN:g}, or an empty cell",
            found=_cell(cells["gain"]),
            remedy="Leave the cell empty if the gain is unknown.",
        )
    return Line(
        number, posixpath.normpath(canonical(file)), canonical(cells.get("view", "")) or None, angle, gain
    )


def _cell(text: str) -> str:
    """Return the text of an invalid number for messages."""
    comma = decimal_comma([text])
    return f"{comma} with a decimal comma; numbers have a point" if comma else shortened(text)


def table_text(lines: Iterable[tuple[str, str, Exposure, float | None, str]]) -> str:
    """Return a table as CSV text.

    Args:
        lines: file, view, exposure, modulation (see ``FittedAngle``; None if it was not fitted) and note of each
            picture.
    """
    rows: list[list[object]] = [[*_COLUMNS]]
    for file, view, exposure, modulation, note in lines:
        known = "unknown" if exposure.angle is None else f"{exposure.angle:.2f}"
        angle = known if exposure.filtered else "none"
        strength = None if modulation is None else f"{modulation:.2f}"
        rows.append([file, view, angle, f"{exposure.gain:.4f}", strength, note])
    return csv_lines(rows)


FEWEST = 3
"""Smallest number of different angles that determines a Stokes vector."""
NAMING = (
    "Name files like cup_045.jpg, cup_a30.jpg, cup_unknown.jpg or cup_none.jpg (numbers without a letter must be "
    "multiples of 15 or evenly spaced over half a turn); or write angles.csv with the columns file,angle; or use "
    "--angles unknown."
)
_WORDS = "unknown|none"
_NUMBER = r"(?P<mark>angle|pol|a|i)?[-_ ]?(?P<angle>\d{1,3}(?:\.\d+)?)(?P<unit>deg)?"
# A minus before a number is its sign if another separator precedes it: cup_-45, but not cup-45.
_APART = r"(?:[-_ .]*[_ .](?P<minus>-)(?=\d)|[-_ .]+)"
_SINGLE = re.compile(rf"(?P<view>.+?){_APART}(?:{_NUMBER}|(?P<word>{_WORDS}))", re.IGNORECASE)
# Degrees between the marks of a filter's ring. Other numbers need a letter because they may count pictures.
_MARKS = 15
_NUMBERED = re.compile(rf"(?:(?P<view>.+?){_APART}|(?P<alone>-))?(?P<number>\d{{1,3}}(?:\.\d+)?)")
_SMALLEST_STEP = 2.0
"""Smallest step of evenly spaced angles in degrees. Numbers that increase by one may count pictures."""
_ALIKE = 1e-6


def folders_of_angles(root: Path) -> dict[Path, Angle]:
    """Return the subfolders named like angles with their angles, in the order of their names."""
    folders = [path for path in sorted(root.iterdir()) if path.is_dir()]
    names = angles_of_names([path.name for path in folders], folders=True)
    return {
        path: name[1] for path, name in zip(folders, names, strict=True) if name is not None and not name[0]
    }


def angles_of_names(names: Sequence[str], *, folders: bool = False) -> list[tuple[str, Angle] | None]:
    """Return the view and angle that each name states; None for a name without an angle.

    The view is "" for a name that is an angle alone. A number with a letter or a unit is an angle, and so is a multiple
    of 15 below 180. Other numbers are angles if all numbers of a view are evenly spaced over half a turn or a whole
    one, such as 10, 40, ..., 160.

    Args:
        names: file names without suffix, or names of folders.
        folders: True for names of folders. A name such as I_10 is then an angle alone, without a view I.
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
    """Return view and angle of one name of a picture or folder."""
    parts = None if folder else split_name(name)
    if parts is None and (alone := split_name(f"x_{name}")) is not None and alone[0] == "x":
        return "", alone[1]
    return parts


def covers_turn(angles: Sequence[float]) -> bool:
    """Return True if angles in degrees are evenly spaced over 180 or 360 degrees, with or without the end."""
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
    """Return view and angle that a file name states; None without an angle."""
    match = _SINGLE.fullmatch(stem)
    angle = None if match is None else _angle_of(match)
    return None if match is None or angle is None else (match["view"], angle)


def _angle_of(match: re.Match[str]) -> Angle | None:
    """Return the angle of a matched name; None for a number that may count pictures."""
    if match["word"]:
        return parse_angle(match["word"])
    number = -float(match["angle"]) if match["minus"] else float(match["angle"])
    certain = match["mark"] or match["unit"] or (number % _MARKS == 0 and number < 180)
    return number if certain and abs(number) <= 360 else None
