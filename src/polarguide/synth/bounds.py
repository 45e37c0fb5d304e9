"""What the numbers and names of a scene file may be, whatever they are for: the rest is for who uses them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.errors import PolarguideError

REMEDY = "docs/reference/scene-files.md describes the fields."
LARGEST = 1e6
"""Of any number in a scene; lengths beyond it are lost in single precision."""
LONGEST = 1000
"""Of any list: points of a profile or a path, parts of a solid."""
FINEST = {"detail": 512, "segments": 512, "smooth": 64}
"""Of numbers that decide how many triangles there are."""
LONGEST_NAME = 100


def check_numbers(data: Any, where: str, field: str) -> None:
    """Refuse numbers and lists in data of a shape, a texture, a light or an environment that are out of bounds.

    Raises:
        PolarguideError: one is; ``where`` is the file, ``field`` where the data stand in it.
    """
    if isinstance(data, dict):
        for key, value in data.items():
            most = FINEST.get(key, LARGEST)
            if isinstance(value, int | float) and value > most:
                raise _fault(f"{where} ({field}.{key})", f"up to {most:g}", value)
            check_numbers(value, where, f"{field}.{key}")
    elif isinstance(data, list | tuple):
        if len(data) > LONGEST:
            raise _fault(f"{where} ({field})", f"up to {LONGEST} items", len(data))
        for number, value in enumerate(data):
            check_numbers(value, where, f"{field}[{number}]")
    elif isinstance(data, int | float) and not abs(data) <= LARGEST:
        raise _fault(f"{where} ({field})", f"a number from {-LARGEST:g} to {LARGEST:g}", data)


def check_file_name(name: str, where: str) -> None:
    """Refuse a name that is no name of a file: its mesh is written under it.

    Raises:
        PolarguideError: it would lead elsewhere, or cannot be written.
    """
    plain = name.isprintable() and not set(name) & set('/\\:*?"<>|') and not name.startswith(".")
    if not (plain and 0 < len(name) <= LONGEST_NAME):
        expected = f"a name of 1 to {LONGEST_NAME} characters that a file can have"
        raise _fault(where, expected, repr(name)[:LONGEST_NAME])


def require_unicode(path: Path) -> None:
    """Refuse a name of a file whose bytes are no UTF-8: the renderer ends the process over one.

    Raises:
        PolarguideError: it is one.
    """
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        raise PolarguideError(
            path, expected="a name in UTF-8", found="other bytes", remedy="Rename the file or its folder."
        ) from None


def only_fields(data: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """Refuse fields that nothing reads.

    Raises:
        PolarguideError: there are some.
    """
    unknown = sorted(data.keys() - set(known))
    if unknown:
        raise _fault(where, f"only {', '.join(known)}", ", ".join(unknown)[:LONGEST_NAME])


def check_color(color: Any, where: str) -> None:
    """Refuse what is no color: three numbers from 0 to 1, "own", or a texture, which is checked where it is made.

    Raises:
        PolarguideError: it is something else.
    """
    if color == "own" or isinstance(color, dict):
        return
    numbers = color if isinstance(color, list | tuple) else ()
    plain = all(isinstance(c, int | float) and not isinstance(c, bool) and 0 <= c <= 1 for c in numbers)
    if len(numbers) != 3 or not plain:
        expected = 'three numbers from 0 to 1, "own", or a texture {"type": ...}'
        raise _fault(where, expected, repr(color)[:LONGEST_NAME])


def require_light(panorama: NDArray[Any], where: str) -> None:
    """Refuse an environment that is no light.

    Raises:
        PolarguideError: it has values that are negative or not finite.
    """
    if panorama.ndim != 3 or not np.isfinite(panorama).all() or panorama.min() < 0:
        raise _fault(where, "finite radiance of 0 or more in three channels", "something else")


def require_solid(points: NDArray[Any], where: str) -> None:
    """Refuse the vertices [V, 3] of an object that is not there.

    Raises:
        PolarguideError: they are not finite, or all in one place.
    """
    if not (len(points) and np.isfinite(points).all() and np.ptp(points, axis=0).max() > 0):
        raise _fault(f"{where} shape", "an object with an extent", "one without, or one that is not finite")


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=str(found), remedy=REMEDY)
