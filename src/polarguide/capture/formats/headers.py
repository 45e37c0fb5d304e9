"""How large a picture is, from a few bytes of its file: nothing is decoded, and no file is read whole."""

from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from polarguide.capture.formats.arrays import BROKEN
from polarguide.capture.formats.integrity import BIG_TIFF, MOST_BIG_ENTRIES, TIFF, declared_size, tiff_order
from polarguide.capture.formats.radiance import exr_size, hdr_size
from polarguide.files import LARGEST_FILE, read_file

HEAD = 1 << 20
LARGEST_PIXEL = 32
"""Bytes: four channels of 64 bits, as no compression makes them larger."""
ROOM = 1 << 26
"""Bytes of a picture file beside its pixels: previews, profiles, and what else is written there."""


def stated_size(path: Path) -> tuple[int, int] | None:
    """Width and height in the header of a picture or an array; None where there is none to be read.

    PNG, JPEG, TIFF, Radiance HDR, OpenEXR and ``.npy`` state them; other files do not.
    """
    if not path.is_file():  # a pipe, a folder, a link to nowhere: whoever reads it says so
        return None
    with contextlib.suppress(*BROKEN, struct.error, OverflowError), open(path, "rb") as file:
        start = file.read(16)
        if start[:4] in (*TIFF, *BIG_TIFF):
            return declared_size(_directory(file, start))
        head = start + file.read(HEAD)
        suffix = path.suffix.lower()
        reader = {".hdr": hdr_size, ".exr": exr_size, ".npy": _array_size}.get(suffix, declared_size)
        return reader(head)
    return None


def read_picture(path: Path) -> bytes:
    """The bytes of a PNG, JPEG or TIFF file, unless it is far larger than its pixels could be.

    Raises:
        PolarguideError: that, or it cannot be read.
    """
    size = stated_size(path)
    largest = ROOM if size is None else min(LARGEST_FILE, ROOM + LARGEST_PIXEL * size[0] * size[1])
    return read_file(path, largest=largest)


def _directory(file: BinaryIO, start: bytes) -> bytes:
    """The head of a TIFF file with its first directory right behind it, wherever it stands in the file."""
    order, big = tiff_order(start), start[:4] in BIG_TIFF
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), start, 8 if big else 4)
    file.seek(at)
    if not big:
        raw = file.read(2)
        (count,) = struct.unpack(order + "H", raw)
        return start[:4] + struct.pack(order + "I", 8) + raw + file.read(12 * count)
    raw = file.read(8)
    (count,) = struct.unpack(order + "Q", raw)
    return start[:8] + struct.pack(order + "Q", 16) + raw + file.read(20 * min(count, MOST_BIG_ENTRIES))


def _array_size(head: bytes) -> tuple[int, int] | None:
    """Of an ``.npy`` file of two or more axes, rows first."""
    stream = io.BytesIO(head)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape = read(stream)[0]
    return (int(shape[1]), int(shape[0])) if len(shape) > 1 else None
