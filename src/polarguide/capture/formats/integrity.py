"""Check that a picture file is complete, by its structure.

Decoders differ in their treatment of truncated files: some refuse them, some return gray or stale rows for the missing
part. Parsing the structure first gives the same answer with every decoder.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from polarguide.capture.formats.decoders import (
    BMP,
    PNM,
    heif_damage,
    heif_head,
    is_heif,
    is_webp,
    plain_damage,
    plain_head,
    webp_size,
)
from polarguide.core.errors import PolarguideError

PNG = b"\x89PNG\r\n\x1a\n"
# Within JPEG scan data, 0xFF followed by 0 is a stuffed byte and by 0xD0-0xD7 a restart; all else ends it.
_JPEG_SCAN_END = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
_TIFF_CODES = {1: "B", 3: "H", 4: "I"}
ORIENTATION = 274
TIFF = (b"II*\0", b"MM\0*")
BIG_TIFF = (b"II+\0", b"MM\0+")
# Marks without a length: one that nobody uses, and restarts.
_JPEG_ALONE = (0x01, *range(0xD0, 0xD8))
MOST_ENTRIES = 4096
"""Entries of a TIFF directory that are read: files have some thirty, and a count of BigTIFF may claim 2^64."""
# Of a progressive JPEG file. Encoders write ten or so; each is decoded over the whole picture, be it empty or not.
_MOST_SCANS = 200
LARGEST_PIXELS = 150_000_000
"""More pixels than any camera has: a file that claims more is refused before memory is taken for it."""
_TIFF_STRIPS = ((273, 279), (324, 325))


def damaged(path: Path, expected: str, found: str) -> PolarguideError:
    """The error that a file cannot be decoded."""
    return PolarguideError(path, expected=expected, found=found, remedy="Copy or export the file again.")


def find_damage(data: bytes) -> str | None:
    """The damage that the structure of a picture file shows, in words, or None.

    Args:
        data: the whole file.

    Returns:
        A noun phrase for the "found" part of a message: "an empty file", "a PNG file cut short", ...
    """
    if not data:
        return "an empty file"
    if data.startswith(PNG):
        return _png_damage(data)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_damage(data)
    if data[:4] in TIFF:
        if not _tiff_is_complete(data):
            return f"a TIFF file cut short (it ends after {len(data)} bytes)"
        return None if _tiff_size(data) is not None else "a TIFF file without one plain size"
    if data[:4] in BIG_TIFF:  # the decoder finds what is cut short
        return None if declared_size(data) is not None else "a BigTIFF file without one plain size"
    if data[:2] == BMP or data[:2] in PNM or is_webp(data):
        return plain_damage(data)
    if is_heif(data):
        return heif_damage(data)
    return "a file of another kind"


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a picture file; None where decoders might see others, or none."""
    if data.startswith(PNG):
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" and len(data) >= 24 else None
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    if is_webp(data):
        return webp_size(data)
    if data[:2] == BMP or data[:2] in PNM:
        head = plain_head(data)
        return None if head is None else head.size
    if is_heif(data):
        turned = heif_head(data)
        return None if turned is None else turned.size
    return _tiff_size(data) if data[:4] in (*TIFF, *BIG_TIFF) else None


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the chunks of a PNG file; the last may end beyond the file."""
    at = len(PNG)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield kind, at, at + 12 + length
        at += 12 + length


def png_chunk(data: bytes, kind: bytes) -> bytes | None:
    """The content of the first chunk of a kind in a PNG file; None where there is none."""
    return next((data[at + 8 : end - 4] for name, at, end in png_chunks(data) if name == kind), None)


def significant_bits(data: bytes) -> int | None:
    """The largest count of significant bits of gray or a color that a PNG file states (sBIT)."""
    stated = png_chunk(data, b"sBIT")
    return max(stated[:3] if len(stated) > 2 else stated[:1]) if stated else None


def _jpeg_marks(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Kinds of the segments and scans of a JPEG file up to its end-of-image mark, and where their contents lie."""
    at = 2
    while at + 2 <= len(data) and data[at] == 0xFF:
        kind, end = data[at + 1], at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == 0xFF:  # fill byte
            at += 1
        elif kind in _JPEG_ALONE:
            at += 2
        else:
            yield kind, at + 4, end
            mark = _JPEG_SCAN_END.search(data, end) if kind == 0xDA else None
            at = mark.start() if mark is not None else end
            if kind == 0xD9 or (kind == 0xDA and mark is None):
                return


def jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the segments of a JPEG file before its first scan."""
    for kind, start, end in _jpeg_marks(data):
        if kind == 0xDA:
            return
        yield kind, data[start:end]


def tiff_entries(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Tag, type and count of the entries in the first directory of a TIFF or BigTIFF file, and places of their values.

    Raises:
        struct.error, OverflowError: the file is too short.
    """
    order, big = tiff_order(data), data[:4] in BIG_TIFF  # places and counts of BigTIFF have 64 bits
    head, counter, place = ("HHQ", "Q", 12) if big else ("HHI", "H", 8)
    (start,) = struct.unpack_from(order + head[2:], data, 8 if big else 4)
    (count,) = struct.unpack_from(order + counter, data, start)
    first, size = start + struct.calcsize(counter), 20 if big else 12
    for at in range(first, first + size * min(count, MOST_ENTRIES), size):
        yield *struct.unpack_from(order + head, data, at), at + place


def tiff_order(data: bytes) -> str:
    """The order of bytes of a TIFF file, for ``struct``."""
    return "<" if data[:2] == b"II" else ">"


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    for kind, content in jpeg_segments(data):
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC) and len(content) >= 5:
            height, width = struct.unpack_from(">HH", content, 1)
            return width, height
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """The same of a TIFF or BigTIFF file; None where a side has another type than usual or stands there twice."""
    codes = {3: "H", 4: "I", 16: "Q"} if data[:4] in BIG_TIFF else {3: "H", 4: "I"}
    sides: dict[int, int] = {}
    try:
        for tag, kind, _, at in tiff_entries(data):
            if tag in (256, 257):
                if tag in sides or kind not in codes:
                    return None
                (sides[tag],) = struct.unpack_from(tiff_order(data) + codes[kind], data, at)
    except (struct.error, OverflowError):
        return None
    return (sides[256], sides[257]) if len(sides) == 2 else None


def _png_damage(data: bytes) -> str | None:
    """Walk the chunks of a PNG file and check their checksums."""
    if declared_size(data) is None and len(data) >= 24:
        return "a PNG file that does not begin with its size"
    for kind, at, end in png_chunks(data):
        if end > len(data):
            break
        (stored,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stored:
            return f"a damaged PNG file (wrong checksum at byte {at})"
        if kind == b"acTL":  # decoders show any one of its pictures, or none
            return "an animated PNG file"
        if kind == b"IEND":
            return None
    return f"a PNG file cut short (it ends after {len(data)} bytes)"


def _jpeg_damage(data: bytes) -> str | None:
    """Whether a JPEG file ends with its end-of-image mark, has a size, and not too many scans."""
    kinds = [kind for kind, _, _ in _jpeg_marks(data)]
    if 0xD9 not in kinds:
        return f"a JPEG file cut short (it ends after {len(data)} bytes)"
    if kinds.count(0xDA) > _MOST_SCANS:
        return f"a JPEG file of {kinds.count(0xDA)} scans"
    return None if _jpeg_size(data) is not None else "a JPEG file without a size"


def _tiff_is_complete(data: bytes) -> bool:
    """Whether the first directory of a TIFF file and all of its strips or tiles lie within the file."""
    order, tags = tiff_order(data), {}
    try:
        for tag, kind, length, place in tiff_entries(data):
            size = length * _TIFF_SIZES.get(kind, 0)
            at = place if size <= 4 else struct.unpack_from(order + "I", data, place)[0]
            if at + size > len(data):
                return False
            if kind in _TIFF_CODES and any(tag in pair for pair in _TIFF_STRIPS):
                tags[tag] = struct.unpack_from(f"{order}{length}{_TIFF_CODES[kind]}", data, at)
    except struct.error:
        return False
    for offsets, sizes in _TIFF_STRIPS:
        if offsets in tags and sizes in tags:
            ends = (at + size for at, size in zip(tags[offsets], tags[sizes], strict=False))
            return all(end <= len(data) for end in ends)
    return True
