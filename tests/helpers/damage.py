"""Ways to spoil the files of a source."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np


def truncated(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def garbage(path: Path) -> None:
    path.write_bytes(b"no such thing " * 40)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    """Reading it would wait for ever."""
    path.unlink()
    os.mkfifo(path)


def loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def duplicate(path: Path) -> None:
    """A second file for the same place, by another suffix."""
    other = {".png": ".tif", ".npy": ".png"}.get(path.suffix, path.suffix.upper())
    path.with_suffix(other).write_bytes(path.read_bytes())


def bomb(path: Path) -> None:
    """A small file that says it is huge."""
    suffix, data = path.suffix, path.read_bytes()
    if suffix == ".png":
        head = struct.pack(">IIBBBBB", 100_000, 100_000, 16, 0, 0, 0, 0)
        parts = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
        chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
        data = b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
    elif suffix == ".jpg":
        at = data.index(b"\xff\xc0")
        data = data[: at + 5] + struct.pack(">HH", 65_000, 65_000) + data[at + 9 :]
    elif suffix == ".npy":
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 1 << 20, 3)}
            )
        return
    elif suffix == ".hdr":
        data = data.replace(b"-Y 48 +X 64", b"-Y 90000 +X 90000")
    elif suffix == ".exr":
        at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        data = data[:at] + struct.pack("<4i", 0, 0, 99_999, 99_999) + data[at + 16 :]
    path.write_bytes(data)


EVERYWHERE: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated": (truncated, r"cut short|complete|bytes for|cannot be developed"),
    "zero bytes": (empty, r"an empty file|bytes for .* found 0"),
    "garbage": (garbage, r"of another kind|(are|is) none|something else|bytes for|cannot be (developed|unpacked)"),
    "a folder": (folder, r"Is a directory|found (nothing|none)"),
    "a pipe": (pipe, r"a pipe or device|found (nothing|none)"),
    "a symlink loop": (loop, r"symbolic links|found nothing|found none"),
    "a dangling link": (dangling, r"No such file|found nothing|found none"),
    "picture bomb": (bomb, r"more than any camera takes|bytes of another kind|damaged|cut short"),
}  # fmt: skip
"""What can happen to any file, and what is said of it."""


def colmap_binary(root: Path) -> Path:
    """A model v000, v001, v002 of 64x48 with one point, binary."""
    root.mkdir(parents=True)
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 80.0, 82.0, 32.0, 24.0)
    (root / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", 3)
    for index in range(3):
        images += struct.pack("<I7dI", index + 1, 1, 0, 0, 0, 0.1 * index, 0, 2, 1)
        images += f"v{index:03d}.png".encode() + b"\0" + struct.pack("<Q", 0)
    (root / "images.bin").write_bytes(images)
    point = struct.pack("<QQ3d3BdQ", 1, 1, 0, 0, 3, 1, 2, 3, 0.5, 0)
    (root / "points3D.bin").write_bytes(point)
    return root


def patched(offset: int, layout: str, *values: float) -> Callable[[Path], None]:
    """Other numbers in a binary file."""

    def change(path: Path) -> None:
        data = bytearray(path.read_bytes())
        struct.pack_into(layout, data, offset, *values)
        path.write_bytes(bytes(data))

    return change
