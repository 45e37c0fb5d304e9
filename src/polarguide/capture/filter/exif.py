"""The EXIF orientation of JPEG, TIFF and PNG files, and its effect on pixels and polarizer angles."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Calibration
from polarguide.capture.formats.integrity import jpeg_segments, png_chunks, tiff_entries, tiff_order

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
