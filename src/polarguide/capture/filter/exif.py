"""EXIF tags of picture files: the orientation and its effect on pixels and angles, and how a photograph was exposed."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Calibration
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.formats.integrity import jpeg_segments, png_chunks, tiff_entries, tiff_order
from polarguide.capture.formats.pictures import read_picture
from polarguide.errors import PolarguideError, optional_import
from polarguide.files import read_file

_ORIENTATION = 274
_MIRRORED = (2, 4, 5, 7)
_QUARTER = (5, 6, 7, 8)
TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored along the falling diagonal",
    6: "turned by 90 degrees clockwise",
    7: "mirrored along the rising diagonal",
    8: "turned by 90 degrees counter-clockwise",
}
"""What each orientation but 1 does to the stored picture for display."""


def orientation(data: bytes) -> int:
    """The orientation tag of a picture file, 1 to 8; 1 (as stored) where there is none that can be read."""
    try:
        value = _tag(tags_of(data))
    except struct.error:
        value = 1
    return value if 1 <= value <= 8 else 1


def apply_orientation(pixels: NDArray[Any], code: int) -> NDArray[Any]:
    """Pixels [H, W, ...] rotated or mirrored for display, given the orientation tag."""
    if code in (5, 7):
        pixels = pixels.swapaxes(0, 1)
        return np.rot90(pixels, 2) if code == 7 else pixels
    if code in (2, 4):
        return np.flip(pixels, axis=1 if code == 2 else 0)
    return np.rot90(pixels, {1: 0, 3: 2, 6: -1, 8: 1}[code])


def orientation_calibration(code: int) -> Calibration:
    """The change of polarizer angles when the stored picture is rotated or mirrored for display."""
    return Calibration(sense="cw" if code in _MIRRORED else "ccw", zero=90.0 if code in _QUARTER else 0.0)


def tags_of(data: bytes) -> bytes:
    """The TIFF structure that holds the tags of a picture file; empty if there is none."""
    if data.startswith(b"\xff\xd8"):
        segments = (content for kind, content in jpeg_segments(data) if kind == 0xE1)
        return next((content[6:] for content in segments if content.startswith(b"Exif\0\0")), b"")
    if data.startswith(b"\x89PNG"):
        return next((data[at + 8 : end - 4] for kind, at, end in png_chunks(data) if kind == b"eXIf"), b"")
    return data


def _tag(tiff: bytes) -> int:
    """The orientation in the first directory of a TIFF structure, 1 if it has none."""
    if tiff[:4] in (b"II*\0", b"MM\0*"):
        for tag, _, _, at in tiff_entries(tiff):
            if tag == _ORIENTATION:
                return int(struct.unpack_from(tiff_order(tiff) + "H", tiff, at)[0])
    return 1


_MAKER, _MODEL, _DIRECTORY = 271, 272, 34665
_TIME, _F_NUMBER, _ISO = 33434, 33437, 34855
_SIZES = {2: 1, 3: 2, 4: 4, 5: 8}
_LONGEST_TEXT = 200


@dataclass(frozen=True)
class Taken:
    """How a photograph was taken, as its file says.

    Attributes:
        camera: maker and model; empty where it does not say.
        light: how much light was let in and how it was amplified: seconds * ISO / f-number^2; None where it does not
            say the time. ISO and f-number count as 100 and 1 where they are not said.
    """

    camera: str
    light: float | None


def read_taken(path: Path) -> Taken:
    """What a file says about its exposure: EXIF of JPEG, PNG, TIFF and camera raw that is built like TIFF; else LibRaw.

    Raises:
        PolarguideError: the file cannot be read.
    """
    raw = is_camera_raw(path)
    data = read_file(path) if raw else read_picture(path)
    found = taken(data)
    if raw and found.light is None and data[:4] not in (b"II*\0", b"MM\0*"):
        return _by_libraw(path, data) or found
    return found


def taken(data: bytes) -> Taken:
    """What the EXIF tags of a picture file say; damaged ones say nothing."""
    try:
        tiff = tags_of(data)
        if tiff[:4] not in (b"II*\0", b"MM\0*"):
            return Taken("", None)
        first = {tag: (kind, count, at) for tag, kind, count, at in tiff_entries(tiff)}
        camera = " ".join(filter(None, (_text(tiff, first.get(_MAKER)), _text(tiff, first.get(_MODEL)))))
        inner = dict(first)
        if _DIRECTORY in first:
            (start,) = struct.unpack_from(tiff_order(tiff) + "I", tiff, first[_DIRECTORY][2])
            inner |= {tag: (kind, count, at) for tag, kind, count, at in tiff_entries(tiff, start)}
        numbers = [_number(tiff, inner.get(tag)) for tag in (_TIME, _ISO, _F_NUMBER)]
    except struct.error:
        return Taken("", None)
    return Taken(camera, _light(*numbers))


def _light(seconds: float | None, iso: float | None, f_number: float | None) -> float | None:
    """Relative exposure of plausible numbers; None without a time."""
    if seconds is None or not 0 < seconds < 1e5:
        return None
    iso = iso if iso is not None and 0 < iso < 1e8 else 100.0
    f_number = f_number if f_number is not None and 0.1 < f_number < 1000 else 1.0
    return seconds * iso / f_number**2


def _by_libraw(path: Path, data: bytes) -> Taken | None:
    """What LibRaw reads of other camera raw files; None where this version of rawpy does not tell."""
    try:
        with optional_import("rawpy", str(path)).imread(io.BytesIO(data)) as raw:
            about = getattr(raw, "other", None)
            return (
                None if about is None else Taken("", _light(about.shutter, about.iso_speed, about.aperture))
            )
    except PolarguideError:
        raise
    except Exception:  # LibRaw's own; whoever develops the file says what is wrong with it
        return None


def _value(tiff: bytes, entry: tuple[int, int, int] | None) -> bytes:
    """The bytes of an entry's value; none where there is no such entry or its type is another."""
    if entry is None or entry[0] not in _SIZES:
        return b""
    kind, count, at = entry
    size = _SIZES[kind] * min(count, _LONGEST_TEXT if kind == 2 else 1)
    if _SIZES[kind] * count > 4:
        (at,) = struct.unpack_from(tiff_order(tiff) + "I", tiff, at)
    return tiff[at : at + size]


def _text(tiff: bytes, entry: tuple[int, int, int] | None) -> str:
    return _value(tiff, entry).split(b"\0")[0].decode("ascii", "replace").strip()


def _number(tiff: bytes, entry: tuple[int, int, int] | None) -> float | None:
    value, order = _value(tiff, entry), tiff_order(tiff)
    if entry is None or entry[0] == 2 or len(value) < _SIZES.get(entry[0], 1) or not value:
        return None
    if entry[0] == 5:
        above, below = struct.unpack(order + "II", value[:8])
        return above / below if below else None
    found = float(struct.unpack(order + ("H" if entry[0] == 3 else "I"), value)[0])
    return found if math.isfinite(found) else None
