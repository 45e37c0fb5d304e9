"""HEIC files of telephones: their header by its boxes, their pixels and EXIF tags by pillow-heif."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import optional_import

EXTRA = "heic"
"""The extra that brings pillow-heif."""
_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis")
_AVIF = (b"avif", b"avis")
_ORIENTATION_OF_TURNS = (1, 8, 3, 6)
"""EXIF's number for quarter turns counter-clockwise."""
_HIGH_RANGE = {16: "PQ", 18: "HLG"}
"""Transfer characteristics (ITU-T H.273) of displays, which depend on more than the light at a pixel."""


@dataclass(frozen=True)
class HeifHead:
    """What the header of a HEIC file says of its picture.

    Attributes:
        size: width and height as stored, before it is turned. turns: quarter turns counter-clockwise for display.
        mirrored: whether it is mirrored for display.
    """

    size: tuple[int, int]
    turns: int
    mirrored: bool

    @property
    def orientation(self) -> int:
        """The turn as EXIF's number. The tag itself is for information only (ISO/IEC 23008-12)."""
        return _ORIENTATION_OF_TURNS[self.turns]


def is_heif(data: bytes) -> bool:
    """Whether a file is one of telephones, HEIC or AVIF, by its first twelve bytes."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def heif_head(data: bytes) -> HeifHead | None:
    """The header of a HEIC file; None where it states no size of its picture."""
    try:
        boxes = {kind: (start, end) for kind, start, end in _boxes(data, 0, len(data))}
        start, end = boxes[b"meta"]
        meta = {kind: span for kind, *span in _boxes(data, start + 4, end)}
        wide = data[meta[b"pitm"][0]] > 0
        (primary,) = struct.unpack_from(">I" if wide else ">H", data, meta[b"pitm"][0] + 4)
        inside = {kind: span for kind, *span in _boxes(data, *meta[b"iprp"])}
        properties = list(_boxes(data, *inside[b"ipco"]))
        own = [properties[number - 1] for number in _associated(data, inside[b"ipma"][0], primary) if number]
        at = {kind: start for kind, start, _ in own}
        width, height = struct.unpack_from(">II", data, at[b"ispe"] + 4)
        if b"clap" in at:  # encoders fill blocks up, and cut what they added off again
            across, of_across, down, of_down = struct.unpack_from(">4I", data, at[b"clap"])
            width, height = across // of_across, down // of_down
        turns = data[at[b"irot"]] & 3 if b"irot" in at else 0
    except (KeyError, IndexError, ZeroDivisionError, struct.error):
        return None
    return HeifHead((width, height), turns, b"imir" in at) if width and height else None


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the contents of the boxes in a part of a file; the last may end beyond it."""
    while start + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if length == 1:
            (length,) = struct.unpack_from(">Q", data, start + 8)
            head = 16
        length = length or end - start
        if length < head:
            return
        yield kind, start + head, start + length
        start += length


def _associated(data: bytes, start: int, item: int) -> list[int]:
    """Numbers, from 1, of the properties of an item, by the box of associations at ``start``."""
    version, wide = data[start], data[start + 3] & 1
    (count,) = struct.unpack_from(">I", data, start + 4)
    start += 8
    for _ in range(count):
        (number,) = struct.unpack_from(">I" if version else ">H", data, start)
        start += 4 if version else 2
        length, start = data[start], start + 1
        if number == item:
            values = struct.unpack_from(f">{length}{'H' if wide else 'B'}", data, start)
            return [value & (0x7FFF if wide else 0x7F) for value in values]
        start += length * (2 if wide else 1)
    return []


def heif_damage(data: bytes) -> str | None:
    """What is wrong with a HEIC or AVIF file as far as its structure tells, or None."""
    if data[8:12] in _AVIF:
        return "an AVIF file"
    if max((end for _, _, end in _boxes(data, 0, len(data))), default=0) > len(data):
        return f"a HEIC file cut short (it ends after {len(data)} bytes)"
    head = heif_head(data)
    if head is None:
        return "a HEIC file without a size"
    return "a HEIC file that is mirrored for display" if head.mirrored else None


def heif_tags(data: bytes) -> bytes:
    """The EXIF block of a HEIC file; empty where it has none, or pillow-heif is not installed."""
    try:
        opened = optional_import("pillow_heif", "EXIF").open_heif(io.BytesIO(data))
        return bytes(opened.info.get("exif") or b"")
    except Exception:  # no package, or a damaged file: whoever reads its pixels says so
        return b""


def heif_pixels(path: Path, data: bytes) -> tuple[NDArray[Any], int]:
    """The picture of a HEIC file as the camera stored it, before it is turned for display.

    Args:
        path: where ``data`` came from, for messages.
        data: the whole file, without damage that its structure tells.

    Returns:
        [H, W, C] uint8, or uint16 of more than 8 bits, in OpenCV's order of channels; and the value of full scale.

    Raises:
        PolarguideError: pillow-heif is not installed.
        ValueError: the file is of a kind that is not read; the text is a noun phrase that says why.
        Exception: of several kinds, where the file is damaged.
    """
    library, head = optional_import("pillow_heif", str(path), extra=EXTRA), heif_head(data)
    assert head is not None
    opened = library.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, bgr_mode=True)
    if len(opened) > 1:
        raise ValueError(f"a HEIC file of {len(opened)} pictures")
    transfer = (opened.info.get("nclx_profile") or {}).get("transfer_characteristics")
    if transfer in _HIGH_RANGE:
        raise ValueError(f"a HEIC file of high dynamic range ({_HIGH_RANGE[transfer]})")
    bits, pixels = int(opened.info["bit_depth"]), np.asarray(opened)
    pixels = np.rot90(pixels, -head.turns)
    if pixels.shape[1::-1] != head.size:
        raise ValueError("a HEIC file whose picture has another size than its header states")
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels), 255
    # The decoder puts the bits at the top of 16.
    return np.ascontiguousarray(pixels >> (16 - bits)), (1 << bits) - 1
