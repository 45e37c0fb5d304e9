"""What a camera notes about a photograph's exposure, and which camera it was."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.exif import tags_of
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.integrity import tiff_entries, tiff_order
from polarguide.errors import PolarguideError, optional_import
from polarguide.files import read_file

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
