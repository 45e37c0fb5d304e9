"""Polarizer angles that names of files and folders state."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

from polarguide.capture.exposures import Angle, parse_angle

FEWEST = 3
"""Different angles that determine a Stokes vector."""
NAMING = (
    "Name files like cup_045.jpg, cup_a30.jpg, cup_unknown.jpg or cup_none.jpg (numbers without a letter are multiples "
    "of 15 or go evenly around half a turn); or write angles.csv with the columns file,angle, or give --angles unknown."
)
_WORDS = "unknown|none"
_NUMBER = r"(?P<mark>angle|pol|a|i)?[-_ ]?(?P<angle>\d{1,3}(?:\.\d+)?)(?P<unit>deg)?"
# A minus right before a number is its sign if another sign separates it from the view: cup_-45, but not cup-45.
_APART = r"(?:[-_ .]*[_ .](?P<minus>-)(?=\d)|[-_ .]+)"
_SINGLE = re.compile(rf"(?P<view>.+?){_APART}(?:{_NUMBER}|(?P<word>{_WORDS}))", re.IGNORECASE)
# Degrees between the marks of a filter's ring: other numbers need a letter, as they may count pictures.
_MARKS = 15
_NUMBERED = re.compile(rf"(?:(?P<view>.+?){_APART}|(?P<alone>-))?(?P<number>\d{{1,3}}(?:\.\d+)?)")
_SMALLEST_STEP = 2.0
"""Degrees: numbers that rise by one may count pictures."""
_ALIKE = 1e-6


def folders_of_angles(root: Path) -> dict[Path, Angle]:
    """The folders in a folder that are named like angles, in the order of their names."""
    folders = [path for path in sorted(root.iterdir()) if path.is_dir()]
    names = angles_of_names([path.name for path in folders], folders=True)
    return {
        path: name[1] for path, name in zip(folders, names, strict=True) if name is not None and not name[0]
    }


def angles_of_names(names: Sequence[str], *, folders: bool = False) -> list[tuple[str, Angle] | None]:
    """View ("" where the name is an angle alone) and angle that each name states; None where it states none.

    A number counts as an angle if it has a letter or a unit, if it is a multiple of 15 below 180, and where all numbers
    of a view are evenly spaced over half a turn or a whole one: 10, 40, ..., 160, or 0 to 175 by 5. ``folders``: names
    such as I_10 are angles alone, and no view I.
    """
    found = [_stated(name, folders) for name in names]
    numbered: dict[str, list[tuple[int, float]]] = {}
    for place, name in enumerate(names):
        match = _NUMBERED.fullmatch(name)
        if match is not None:
            sign = -1 if match["minus"] or match["alone"] else 1
            numbered.setdefault(match["view"] or "", []).append((place, sign * float(match["number"])))
    for view, places in numbered.items():
        if covers_turn([number for _, number in places]):
            for place, number in places:
                if not folders or found[place] is None:
                    found[place] = view, number
    return found


def _stated(name: str, folder: bool) -> tuple[str, Angle] | None:
    """View and angle of a single name, of a picture or of a folder."""
    found = None if folder else split_name(name)
    if found is None and (alone := split_name(f"x_{name}")) is not None and alone[0] == "x":
        return "", alone[1]
    return found


def covers_turn(angles: Sequence[float]) -> bool:
    """Whether angles in degrees are evenly spaced over half a turn or a whole one, its end included or not."""
    different = sorted(set(angles))
    if len(different) < FEWEST:
        return False
    steps = [b - a for a, b in itertools.pairwise(different)]
    step, count = steps[0], len(different)
    even = step >= _SMALLEST_STEP and all(abs(other - step) < _ALIKE for other in steps)
    return even and any(abs(span - turn) < _ALIKE for span in (step * count, step * (count - 1))
                        for turn in (180.0, 360.0))  # fmt: skip


def split_name(stem: str) -> tuple[str, Angle] | None:
    """View and angle in a file's name; None where it states no angle."""
    match = _SINGLE.fullmatch(stem)
    angle = None if match is None else _angle_of(match)
    return None if match is None or angle is None else (match["view"], angle)


def _angle_of(match: re.Match[str]) -> Angle | None:
    """The angle that a name states; None for numbers that may count pictures."""
    if match["word"]:
        return parse_angle(match["word"])
    number = -float(match["angle"]) if match["minus"] else float(match["angle"])
    certain = match["mark"] or match["unit"] or (number % _MARKS == 0 and number < 180)
    return number if certain and abs(number) <= 360 else None
