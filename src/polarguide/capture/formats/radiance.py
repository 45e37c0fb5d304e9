"""Read linear radiance (.hdr, .exr, .npy) as float pictures of three channels."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.arrays import array_kind, read_array
from polarguide.capture.formats.integrity import damaged
from polarguide.capture.formats.pictures import LARGEST_PIXELS, read_file
from polarguide.errors import PolarguideError, optional_import
from polarguide.files import in_utf8

_HDR_SIZE = re.compile(rb"[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n")
_EXR_MAGIC, _EXR_PARTS = b"\x76\x2f\x31\x01", 0x1000


def read_radiance(path: Path) -> NDArray[np.float32]:
    """Read a linear picture; values may be negative or above 1, and are returned as they are.

    Args:
        path: Radiance ``.hdr``, OpenEXR ``.exr`` (package OpenEXR) or ``.npy`` with [H, W], [H, W, 1] or [H, W, 3].

    Returns:
        [H, W, 3] float32, RGB. A gray picture becomes three equal channels.

    Raises:
        PolarguideError: the file cannot be read, is damaged or of another kind, or a package is missing.
    """
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        pixels = _read_hdr(path)
    elif suffix == ".exr":
        pixels = _read_exr(path)
    else:
        pixels = read_array(path)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or 0 in pixels.shape or pixels.dtype.kind != "f":
        expected = "a picture of floating-point numbers with one or three channels"
        raise PolarguideError(
            path, expected=expected, found=array_kind(pixels), remedy="Export the file again."
        )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), dtype=np.float32)


def _read_hdr(path: Path) -> NDArray[Any]:
    data = read_file(path)
    found = "an empty file" if not data else "a file that is none"
    size, pixels = hdr_size(data), None
    if size is not None:
        width, height = size
        found = f"one that is damaged or cut short (it ends after {len(data)} bytes)"
        # Run lengths reach 127 pixels with two bytes a channel: fewer bytes than this cannot be complete.
        if 0 < height * width <= min(LARGEST_PIXELS, 64 * len(data)):
            pixels = _decoded(data)
    if pixels is None or pixels.dtype != np.float32 or pixels.ndim != 3:
        raise damaged(path, "a complete Radiance HDR file", found)
    return pixels[..., 2::-1]


def _decoded(data: bytes) -> NDArray[Any] | None:
    """Decode a picture file with OpenCV, without its messages."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def _read_exr(path: Path, wanted: tuple[str, ...] | None = None) -> NDArray[Any]:
    data = read_file(path)
    openexr = optional_import("OpenEXR", str(path))
    found = "an empty file" if not data else "one that is damaged, cut short or something else"
    pixels = None
    if data.startswith(_EXR_MAGIC):
        try:
            exr_size(data)
            with in_utf8(path) as name:
                pixels = _exr_channels(name, openexr, wanted)
        except Exception as error:  # the binding raises whatever C++ threw
            found = f"one that is damaged or cut short ({str(error).strip().splitlines()[0]})"
    if pixels is None:
        names = "R, G and B, or Y" if wanted is None else ", ".join(wanted)
        raise damaged(path, f"a complete OpenEXR file with channels {names}", found)
    return pixels


def read_exr_channels(path: Path, groups: Sequence[Sequence[str]]) -> list[NDArray[np.float32]]:
    """Named channels of an OpenEXR file, a picture [H, W, C] for each group of names.

    Raises:
        PolarguideError: the file cannot be read, is damaged or lacks a channel, or the package OpenEXR is missing.
    """
    return [_read_exr(path, tuple(names)) for names in groups]


def hdr_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the head of a Radiance file."""
    # The size stands behind the first empty line; before it, anything may look like one.
    size = _HDR_SIZE.match(data, data.find(b"\n\n", 0, 4096) + 2)
    return None if size is None or not data.startswith(b"#?") else (int(size[2]), int(size[1]))


def exr_size(data: bytes) -> tuple[int, int]:
    """Width and height of the last window in the headers of an OpenEXR file, before the package takes memory for it.

    Raises:
        ValueError, struct.error: one is larger than any picture, or there is none.
    """
    if not data.startswith(_EXR_MAGIC):
        raise ValueError("no OpenEXR file")
    width = height = 0
    (version,) = struct.unpack_from("<I", data, 4)
    at, found = 8, False
    while data[at : at + 1] not in (b"\0", b""):
        while data[at : at + 1] not in (b"\0", b""):
            name = data.index(b"\0", at)
            kind = data.index(b"\0", name + 1)
            (size,) = struct.unpack_from("<I", data, kind + 1)
            if data[at:name] == b"dataWindow":
                left, top, right, bottom = struct.unpack_from("<4i", data, kind + 5)
                width, height, found = right - left + 1, bottom - top + 1, True
                if min(width, height) < 1 or width * height > LARGEST_PIXELS:
                    raise ValueError(f"{width}x{height} pixels")
            at = kind + 5 + size
        at += 1
        if not version & _EXR_PARTS:
            break
    if not found:
        raise ValueError("no size")
    return width, height


def _exr_channels(path: Path, package: Any, wanted: tuple[str, ...] | None) -> NDArray[Any] | None:
    with package.File(str(path), separate_channels=True) as file:
        window = file.header()["dataWindow"]
        width, height = (int(window[1][axis]) - int(window[0][axis]) + 1 for axis in (0, 1))
        if not 0 < width * height <= LARGEST_PIXELS:
            raise ValueError(f"{width}x{height} pixels")
        channels = file.channels()
        choices = (("R", "G", "B"), ("Y",)) if wanted is None else (wanted,)
        names = next((n for n in choices if all(name in channels for name in n)), None)
        if names is None:
            return None
        return np.stack([np.asarray(channels[name].pixels, np.float32) for name in names], axis=-1)
