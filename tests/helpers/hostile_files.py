"""Files that no library would write: headers that lie, archives that unfold, models with wrong numbers."""

from __future__ import annotations

import bz2
import io
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

Tag = tuple[int, int, int, int]
"""Number, type, count and value (or place) of an entry of a TIFF directory."""


def tiff(path: Path, tags: Sequence[Tag], data: bytes = bytes(4096)) -> None:
    """A TIFF file: its directory at byte 8, ``data`` behind it; values of ``-1`` become the place of the data."""
    start = 8 + 2 + 12 * len(tags) + 4
    head = struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    for number, kind, count, value in tags:
        head += struct.pack("<HHII", number, kind, count, start if value == -1 else value)
    path.write_bytes(head + bytes(4) + data)


def gray_tags(width: int, height: int, size: int, kind: int = 4) -> list[Tag]:
    """Tags of a gray TIFF of 16 bits in one strip of ``size`` bytes; ``kind`` is the type of width and height."""
    return [(256, kind, 1, width), (257, kind, 1, height), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1),
            (273, 4, 1, -1), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, size)]  # fmt: skip


def deflated_tiff(path: Path, side: int, *, kind: int = 4, twice: int = 0) -> None:
    """A gray TIFF of ``side`` x ``side`` black pixels, whose strips are all the same few deflated bytes.

    ``kind`` is the type of width and height; where ``twice`` is not 0, both stand there a second time with this value.
    """
    rows = 50
    strips = -(-side // rows)
    packed = zlib.compress(bytes(2 * side * rows), 9)
    tags: list[Tag] = [(256, kind, 1, side), (257, kind, 1, side), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 1),
            (273, 4, strips, 0), (277, 3, 1, 1), (278, 4, 1, rows), (279, 4, strips, 0)]  # fmt: skip
    if twice:
        tags[1:1] = [(256, 4, 1, twice)]
        tags[3:3] = [(257, 4, 1, twice)]
    start = 8 + 2 + 12 * len(tags) + 4
    places, sizes = start + len(packed), start + len(packed) + 4 * strips
    tags = [(n, k, c, {273: places, 279: sizes}.get(n, v)) for n, k, c, v in tags]
    data = (
        packed
        + struct.pack(f"<{strips}I", *[start] * strips)
        + struct.pack(f"<{strips}I", *[len(packed)] * strips)
    )
    tiff(path, tags, data)


def png(path: Path, width: int, height: int, *, bits: int = 16, color: int = 0, idat: bytes | None = None,
        before: Sequence[tuple[bytes, bytes]] = (), first: Sequence[tuple[bytes, bytes]] = ()) -> None:  # fmt: skip
    """A PNG file of black pixels, with further chunks ``before`` its pixels or ``first`` of all."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[color]
    if idat is None:
        packer, row = zlib.compressobj(9), bytes(1 + (width * channels * bits + 7) // 8)
        idat = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0))
    chunks = [*first, head, *before, (b"IDAT", idat), (b"IEND", b"")]
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def segment(kind: int, content: bytes) -> bytes:
    """A segment of a JPEG file."""
    return struct.pack(">BBH", 0xFF, kind, 2 + len(content)) + content


def scans_jpeg(path: Path, side: int, scans: int) -> None:
    """A progressive gray JPEG of few bytes with many scans, each over all of a huge picture."""
    blocks = (-(-side // 8)) ** 2
    data = b"\xff\xd8" + segment(0xDB, b"\0" + bytes([1]) * 64)
    data += segment(0xC2, struct.pack(">BHHB3B", 8, side, side, 1, 1, 0x11, 0))
    data += segment(0xC4, bytes([0x10, 1]) + bytes(15) + b"\xe0")  # one code: a run of 2^14 blocks and more
    bits = ""
    while blocks > 0:
        run = min(blocks, (1 << 15) - 1)
        run = run if run >= 1 << 14 else 1 << 14
        bits += "0" + format(run - (1 << 14), "014b")
        blocks -= run
    bits += "1" * (-len(bits) % 8)
    coded = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    scan = segment(0xDA, bytes([1, 1, 0, 1, 63, 0])) + coded
    path.write_bytes(data + scan * scans + b"\xff\xd9")


def two_sizes_jpeg(path: Path, side: int) -> None:
    """A JPEG file whose size a reader sees otherwise than a decoder: a mark without a length stands before it."""
    hidden = segment(0xC0, struct.pack(">BHHB3B", 8, 20, 24, 1, 1, 0x11, 0))
    data = b"\xff\xd8" + b"\xff\x01"  # TEM stands alone; who takes what follows for its length jumps
    filler = segment(0xFE, bytes(0xFFFE - 2 - 2 - 2))
    body = segment(0xDB, b"\0" + bytes([1]) * 64)
    body += segment(0xC0, struct.pack(">BHHB3B", 8, side, side, 1, 1, 0x11, 0))
    body += segment(0xC4, bytes([0x00, 1]) + bytes(15) + b"\0")
    body += segment(0xC4, bytes([0x10, 1]) + bytes(15) + b"\0")
    body += segment(0xDA, bytes([1, 1, 0, 0, 63, 0])) + bytes((side // 8) ** 2 // 4)
    path.write_bytes(data + filler + segment(0xFE, hidden) + body + b"\xff\xd9")


def header(array: str, *, version: tuple[int, int] = (1, 0)) -> bytes:
    """The head of an ``.npy`` file with any text in place of its dictionary."""
    text = array.encode() + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text


def npy(array: np.ndarray) -> bytes:
    """An array as ``.npy``."""
    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()


def archive(path: Path, members: Sequence[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> None:
    """A zip file; names may come twice."""
    import warnings

    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", method) as file:
        warnings.simplefilter("ignore")
        for name, data in members:
            file.writestr(name, data)


def lying_archive(
    path: Path, name: str, unfolds: int, *, says: int, method: int = zipfile.ZIP_DEFLATED
) -> None:
    """A zip file of one member that says it has ``says`` bytes, and unfolds to far more."""
    begin = header("{'descr': '<f4', 'fortran_order': False, 'shape': (20, 24), }")
    if method == zipfile.ZIP_DEFLATED:
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        head = packer.compress(begin) + packer.flush(zlib.Z_FULL_FLUSH)
        zeros = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
        packed = head + zeros * (unfolds >> 24) + packer.flush()
    elif method == zipfile.ZIP_BZIP2:
        squeezer = bz2.BZ2Compressor(9)
        parts = [squeezer.compress(begin), *(squeezer.compress(bytes(1 << 24)) for _ in range(unfolds >> 24))]
        packed = b"".join(parts) + squeezer.flush()
    else:
        packed = (
            b"\x09\x04\x05\x00\x5d\xff\xff\xff\xff" + b"\xff" * 200
        )  # LZMA with a dictionary of 4 GiB, and junk
    raw, flags = name.encode(), 0
    local = (
        struct.pack("<4s5H3I2H", b"PK\x03\x04", 63, flags, method, 0, 0, 0, len(packed), says, len(raw), 0)
        + raw
    )
    central = struct.pack("<4s6H3I5H2I", b"PK\x01\x02", 63, 63, flags, method, 0, 0, 0, len(packed), says, len(raw),
                          0, 0, 0, 0, 0, 0) + raw  # fmt: skip
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, 1, 1, len(central), len(local) + len(packed), 0)
    path.write_bytes(local + packed + central + end)


def exr(path: Path, side: int) -> None:
    """An EXR file of few bytes whose window is ``side`` x ``side``; its lines are missing."""

    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value

    window = struct.pack("<4i", 0, 0, side - 1, side - 1)
    channels = (
        b"".join(name + b"\0" + struct.pack("<IB3xII", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    )
    data = b"\x76\x2f\x31\x01\x02\0\0\0"
    data += attribute(b"channels", b"chlist", channels) + attribute(b"compression", b"compression", b"\x03")
    data += attribute(b"dataWindow", b"box2i", window) + attribute(b"displayWindow", b"box2i", window)
    data += attribute(b"lineOrder", b"lineOrder", b"\0") + attribute(
        b"pixelAspectRatio", b"float", struct.pack("<f", 1)
    )
    data += attribute(b"screenWindowCenter", b"v2f", bytes(8)) + attribute(
        b"screenWindowWidth", b"float", struct.pack("<f", 1)
    )
    data += b"\0"
    lines = -(-side // 16)
    packed = zlib.compress(bytes(side * 16 * 12), 9)
    at = len(data) + 8 * lines
    block = struct.pack("<iI", 0, len(packed)) + packed
    path.write_bytes(data + struct.pack("<Q", at) * lines + block)


def two_sizes_hdr(path: Path, side: int) -> None:
    """A Radiance file that names a small size in a comment and a huge one where it belongs."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n-Y 4 +X 4\n\n" + f"-Y {side} +X {side}\n".encode()
    path.write_bytes(head + bytes(1 << 20))


# COLMAP, binary.


def cameras_bin(
    cameras: Sequence[tuple[int, int, int, int, Sequence[float]]], count: int | None = None
) -> bytes:
    """Number, model, width, height and parameters of each."""
    parts = [struct.pack("<IiQQ", n, m, w, h) + struct.pack(f"<{len(p)}d", *p) for n, m, w, h, p in cameras]
    return struct.pack("<Q", len(cameras) if count is None else count) + b"".join(parts)


def images_bin(
    images: Sequence[tuple[int, Sequence[float], int, bytes, Sequence[tuple[float, float, int]]]],
) -> bytes:
    """Number, pose (7 numbers), camera, name and points of each."""
    parts = []
    for number, pose, camera, name, points in images:
        part = struct.pack("<I7dI", number, *pose, camera) + name + b"\0" + struct.pack("<Q", len(points))
        parts.append(part + b"".join(struct.pack("<ddQ", *point) for point in points))
    return struct.pack("<Q", len(images)) + b"".join(parts)


def points_bin(points: Sequence[tuple[int, Sequence[float], Sequence[tuple[int, int]]]]) -> bytes:
    """Number, place and track of each."""
    parts = []
    for number, place, track in points:
        part = struct.pack("<Q3d3Bd", number, *place, 1, 2, 3, 0.5) + struct.pack("<Q", len(track))
        parts.append(part + b"".join(struct.pack("<II", *seen) for seen in track))
    return struct.pack("<Q", len(points)) + b"".join(parts)
