"""Check the structure of a COLMAP model's binary files.

COLMAP reads truncated files without an error and keeps whatever was in memory, and counts in a damaged file can keep it
busy forever. Parsing the structure first gives a clear error.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path

from polarguide.capture.colmap.write import MODELS
from polarguide.capture.formats.pictures import read_file
from polarguide.errors import PolarguideError

_PARAMETERS = dict(MODELS.values())
_LONGEST_NAME = 4096


def check_model_files(folder: Path, kind: str) -> None:
    """Check the files of a model, of suffix ``kind``; missing files are skipped.

    Of text files, which pycolmap checks itself, only the colors of points are looked at.

    Raises:
        PolarguideError: a file is truncated, damaged, or has trailing bytes.
    """
    walkers: dict[str, Callable[[bytes], int]] = {
        "cameras": _cameras, "images": _images, "points3D": _points, "rigs": _rigs, "frames": _frames,
    }  # fmt: skip
    for name, walk in walkers.items():
        path = folder / (name + kind)
        if not path.exists():
            continue
        data = read_file(path)
        found = "an empty file" if not data and name != "points3D" else None
        if kind == ".bin":
            try:
                end = walk(data)
                if end != len(data):
                    found = f"{len(data)} bytes where its counts require {end}"
            except (struct.error, ValueError) as error:
                found = f"a damaged one ({error})" if data else "an empty file"
        elif name == "points3D":
            found = _strange_color(data)
        if found is not None:
            raise PolarguideError(
                path,
                expected=f"a complete COLMAP {name}{kind}",
                found=found,
                remedy="Copy or export the model again.",
            )


def _strange_color(data: bytes) -> str | None:
    """A line of ``points3D.txt`` with a color that pycolmap would take modulo 256; None where there is none.

    What is no number at all, pycolmap finds itself.
    """
    for number, line in enumerate(data.splitlines(), 1):
        cells = line.split(None, 7)[4:7]
        if line[:1] != b"#" and any(
            cell.lstrip(b"-").isdigit() and not (len(cell) <= 3 and 0 <= int(cell) <= 255) for cell in cells
        ):
            color = ", ".join(cell.decode("ascii", "replace")[:20] for cell in cells)
            return f"a color of {color} in line {number}, whose parts go from 0 to 255"
    return None


def _cameras(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 48)):
        _, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if not (0 < width < 1 << 20 and 0 < height < 1 << 20):
            raise ValueError(f"a camera of {width}x{height} pixels")
        if model not in _PARAMETERS:  # a newer model: its length is not known here
            return len(data)
        at += 24 + 8 * _PARAMETERS[model]
    return at


def _images(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 73)):
        if not all(map(math.isfinite, struct.unpack_from("<7d", data, at + 4))):
            raise ValueError("an image whose pose is not finite")
        name = data.find(b"\0", at + 64, at + 64 + _LONGEST_NAME)
        if name < 0:
            raise ValueError("an image without the end of its name")
        (points,) = struct.unpack_from("<Q", data, name + 1)
        at = name + 9 + 24 * _at_most(points, (len(data) - name) // 24)
    return at


def _points(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 51)):
        (track,) = struct.unpack_from("<Q", data, at + 43)
        at += 51 + 8 * _at_most(track, (len(data) - at) // 8)
    return at


def _rigs(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 8)):
        _, sensors = struct.unpack_from("<II", data, at)
        at += 8
        for sensor in range(_at_most(sensors, (len(data) - at) // 8)):
            at += 8
            if sensor:  # the first is the rig's own place
                (has_pose,) = struct.unpack_from("<B", data, at)
                at += 1 + 56 * bool(has_pose)
        if at > len(data):
            raise ValueError("a rig without its end")
    return at


def _frames(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 68)):
        (pictures,) = struct.unpack_from("<I", data, at + 64)
        at += 68
        at += 16 * _at_most(pictures, (len(data) - at) // 16)
    return at


def _at_most(count: int, most: int) -> int:
    """The count, if the file is long enough for it."""
    if count > most:
        raise ValueError(f"a count of {count} that the file is too short for")
    return count
