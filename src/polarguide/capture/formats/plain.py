"""Headers of BMP, PGM, PPM and WebP files, and the samples of those that are not compressed."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BMP = b"BM"
PNM = (b"P5", b"P6")
_PNM_HEAD = re.compile(
    rb"P[56](?:\s+|#[^\n]*\n)+?(\d{1,9})(?:\s+|#[^\n]*\n)+?(\d{1,9})(?:\s+|#[^\n]*\n)+?(\d{1,5})\s"
)
_LARGEST_HEAD = 4096
_BMP_BITS = (8, 24, 32)
_ANIMATED = 2


@dataclass(frozen=True)
class PlainHead:
    """What the header of an uncompressed file says.

    Attributes:
        size: width and height. channels: samples of a pixel. full: value of full scale.
        start: where the samples begin. row: bytes of a row. rising: whether the lowest row comes first.
    """

    size: tuple[int, int]
    channels: int
    full: int
    start: int
    row: int
    rising: bool = False

    @property
    def end(self) -> int:
        """Where the samples end."""
        return self.start + self.row * self.size[1]


def is_webp(data: bytes) -> bool:
    """Whether a file is a WebP picture, by its first twelve bytes."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def plain_head(data: bytes) -> PlainHead | None:
    """The header of a PGM, PPM or BMP file; None where it has none that is read."""
    if data[:2] in PNM:
        match = _PNM_HEAD.match(data[:_LARGEST_HEAD])
        if match is None:
            return None
        width, height, full = (int(text) for text in match.groups())
        channels = 1 if data[:2] == b"P5" else 3
        row = width * channels * (1 if full < 256 else 2)
        return PlainHead((width, height), channels, full, match.end(), row) if 0 < full < 1 << 16 else None
    if data[:2] != BMP or len(data) < 54:
        return None
    start, head, width, height, _, bits, packing = struct.unpack_from("<IIiiHHI", data, 10)
    if head < 40 or bits not in _BMP_BITS or packing or width <= 0 or not height:
        return None
    row = (width * bits // 8 + 3) // 4 * 4
    return PlainHead((width, abs(height)), bits // 8, 255, start, row, rising=height > 0)


def plain_pixels(data: bytes, head: PlainHead) -> NDArray[Any]:
    """The samples of a file that holds all that its header promises: [H, W] or [H, W, 3] in OpenCV's order.

    Palettes of 8-bit BMP files are applied, unless they are the levels of gray.
    """
    width, height = head.size
    rows = np.frombuffer(data, np.uint8, head.row * height, head.start).reshape(height, head.row)
    if data[:2] in PNM:
        samples = rows if head.full < 256 else rows.view(">u2").astype(np.uint16)
        pixels = samples.reshape(height, width, head.channels)
        return pixels[..., 0].copy() if head.channels == 1 else pixels[..., ::-1].copy()
    pixels = rows[:, : width * head.channels].reshape(height, width, head.channels)
    pixels = pixels[::-1] if head.rising else pixels
    if head.channels > 1:
        return pixels[..., :3].copy()  # the fourth byte is padding
    (length,) = struct.unpack_from("<I", data, 14)
    (used,) = struct.unpack_from("<I", data, 46)
    palette = np.zeros((256, 4), np.uint8)
    stored = np.frombuffer(data[14 + length : min(head.start, 14 + length + 4 * (used or 256))], np.uint8)
    palette[: len(stored) // 4] = stored[: len(stored) // 4 * 4].reshape(-1, 4)
    colors = palette[:, :3]
    gray = (colors == colors[:, :1]).all()
    return np.asarray(colors[pixels[..., 0], 0] if gray else colors[pixels[..., 0]])


def webp_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the contents of the chunks of a WebP file; the last may end beyond the file."""
    at = 12
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        yield kind, at + 8, at + 8 + length
        at += 8 + length + length % 2


def webp_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a WebP file; None where there are none, or of an animation."""
    for kind, at, _ in webp_chunks(data):
        head = data[at : at + 10]
        if len(head) < 10:
            return None
        if kind == b"VP8X":
            if head[0] & _ANIMATED:
                return None
            return 1 + int.from_bytes(head[4:7], "little"), 1 + int.from_bytes(head[7:10], "little")
        if kind == b"VP8L":
            packed = int.from_bytes(head[1:5], "little")
            return 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
        if kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", head, 6)
            return width & 0x3FFF, height & 0x3FFF
        return None
    return None


def plain_damage(data: bytes) -> str | None:
    """What is wrong with a BMP, PGM, PPM or WebP file as far as its structure tells, or None."""
    if is_webp(data):
        if webp_size(data) is None:
            return "a WebP file without a size, or an animated one"
        chunks = list(webp_chunks(data))
        return (
            None if chunks[-1][2] <= len(data) else f"a WebP file cut short (it ends after {len(data)} bytes)"
        )
    name = "BMP" if data[:2] == BMP else "PGM or PPM"
    head = plain_head(data)
    if head is None:
        kinds = "8, 24 or 32 bits a pixel, not compressed" if name == "BMP" else "a size and full scale"
        return f"a {name} file without {kinds}"
    if head.start < 2 or head.end > len(data):
        return f"a {name} file cut short (it ends after {len(data)} bytes)"
    return None
