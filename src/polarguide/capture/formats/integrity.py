"""Check that a picture file is complete, by its structure.

Decoders differ in their treatment of truncated files: some refuse them, some return gray or stale rows for the missing
part. Parsing the structure first gives the same answer with every decoder.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from polarguide.capture.formats.decoders import (
    BIG_TIFF,
    BMP,
    PNM,
    TIFF,
    heif_damage,
    heif_head,
    is_heif,
    is_webp,
    pillow_damage,
    pillow_size,
    pnm_damage,
    pnm_head,
    tiff_damage,
    tiff_size,
)
from polarguide.core.errors import PolarguideError

PNG = b"\x89PNG\r\n\x1a\n"
# Within JPEG scan data, 0xFF followed by 0 is a stuffed byte and by 0xD0-0xD7 a restart; all else ends it.
_JPEG_SCAN_END = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
ORIENTATION = 274
# Marks without a length: one that nobody uses, and restarts.
_JPEG_ALONE = (0x01, *range(0xD0, 0xD8))
# Of a progressive JPEG file. Encoders write ten or so; each is decoded over the whole picture, be it empty or not.
_MOST_SCANS = 200
LARGEST_PIXELS = 150_000_000
"""More pixels than any camera has: a file that claims more is refused before memory is taken for it."""


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
    if data[:4] in (*TIFF, *BIG_TIFF):
        return tiff_damage(data)
    if data[:2] == BMP or is_webp(data):
        return pillow_damage(data)
    if data[:2] in PNM:
        return pnm_damage(data)
    if is_heif(data):
        return heif_damage(data)
    return "a file of another kind"


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a picture file; None where decoders might see others, or none."""
    if data.startswith(PNG):
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" and len(data) >= 24 else None
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    if data[:2] == BMP or is_webp(data):
        return pillow_size(data)
    if data[:2] in PNM:
        head = pnm_head(data)
        return None if head is None else head.size
    if is_heif(data):
        turned = heif_head(data)
        return None if turned is None else turned.size
    return tiff_size(io.BytesIO(data)) if data[:4] in (*TIFF, *BIG_TIFF) else None


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
        kind = data[at + 1]
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
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


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    for kind, content in jpeg_segments(data):
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC) and len(content) >= 5:
            height, width = struct.unpack_from(">HH", content, 1)
            return width, height
    return None


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
