"""The EXIF orientation of JPEG, TIFF and PNG files, and its effect on pixels and polarizer angles."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Calibration

_ORIENTATION = 274
_MIRRORED = (2, 4, 5, 7)
_QUARTER = (5, 6, 7, 8)


def orientation(data: bytes) -> int:
    """The orientation tag of a picture file, 1 to 8; 1 (as stored) where there is none that can be read."""
    if data.startswith(b"\xff\xd8"):
        block = _jpeg_exif(data)
    elif data.startswith(b"\x89PNG"):
        block = _png_exif(data)
    else:
        block = data
    try:
        value = _tag(block)
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


def _jpeg_exif(data: bytes) -> bytes:
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + length
    return b""


def _png_exif(data: bytes) -> bytes:
    at = 8
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"eXIf":
            return data[at + 8 : at + 8 + length]
        at += 12 + length
    return b""


def _tag(tiff: bytes) -> int:
    """The orientation in the first directory of a TIFF structure, 1 if it has none."""
    if tiff[:4] not in (b"II*\0", b"MM\0*"):
        return 1
    order = "<" if tiff[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", tiff, 4)
    (count,) = struct.unpack_from(order + "H", tiff, start)
    for index in range(count):
        tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, start + 2 + 12 * index)
        if tag == _ORIENTATION:
            return int(value)
    return 1
