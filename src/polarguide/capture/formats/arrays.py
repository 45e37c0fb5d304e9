"""Read NumPy files and linear radiance (.hdr, .exr, .npy); sizes are checked before allocation."""

from __future__ import annotations

import io
import math
import re
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.headers import LARGEST_PIXELS, damaged
from polarguide.core.errors import PolarguideError, optional_import, require
from polarguide.core.files import in_utf8, read_file

_LARGEST_HEADER = 1 << 16
BROKEN = (
    *(ValueError, TypeError, EOFError, OSError, MemoryError, SyntaxError, RuntimeError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""What decoding raises for files that are damaged, encrypted, or lie; NumPy parses headers as Python."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Largest uncompressed size of an ``.npz`` file of cameras, in bytes.
_LARGEST_ARCHIVE = 1 << 26


def array_size(array: NDArray[Any]) -> str:
    """The shape of an array in words: "3x4"."""
    return "x".join(map(str, array.shape)) or "a single value"


def array_kind(array: NDArray[Any]) -> str:
    """Shape and type of an array in words, for messages."""
    return f"an array {array_size(array)} of {array.dtype}"


def wrong_camera(where: object, expected: str, found: str) -> PolarguideError:
    """The error that the numbers of a camera make no sense."""
    return PolarguideError(where, expected=expected, found=found, remedy="Export the cameras again.")


def require_camera(condition: object, where: object, expected: str, found: str) -> None:
    """Check a condition on the numbers of a camera.

    Raises:
        PolarguideError: the condition does not hold.
    """
    if not condition:
        raise wrong_camera(where, expected, found)


def read_array(path: Path) -> NDArray[Any]:
    """The array in an ``.npy`` file.

    Raises:
        PolarguideError: the file cannot be read, is truncated or no ``.npy`` file, or holds Python objects.
    """
    data = read_file(path)
    try:
        return _array(data, "biuf")
    except BROKEN as error:
        raise damaged(
            path,
            "a complete .npy file of numbers",
            "an empty file" if not data else f"{len(data)} bytes of another kind",
        ) from error


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays in an ``.npz`` file of cameras, by name; see ``decode_arrays``."""
    return decode_arrays(path, read_file(path))


def decode_arrays(
    path: Path,
    data: bytes,
    names: Collection[str] | None = None,
    largest: int = _LARGEST_ARCHIVE,
    *,
    kinds: str = "biuf",
    expected: str = "a complete .npz file of numbers",
    remedy: str = "Copy or export the file again.",
) -> dict[str, NDArray[Any]]:
    """Decode the arrays of an ``.npz`` file.

    Args:
        path: for messages. data: the whole file.
        names: names of the arrays, of which some may be missing; None: all. largest: bytes that they may take together.
        kinds: types of their values, as NumPy calls them. expected, remedy: for messages.

    Raises:
        PolarguideError: the file is damaged or encrypted, or decompresses to more data than ``largest``.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            chosen = members.keys() if names is None else members.keys() & {*names}
            size = sum(members[name].file_size for name in chosen)
            if size > largest:
                raise ValueError(f"an archive that decompresses to {size} bytes")
            return {
                name: _array(_member(archive, members[name]), kinds) for name in members if name in chosen
            }
    except BROKEN as error:
        damage = "one that cannot be unpacked" if isinstance(error, zipfile.BadZipFile) else "a damaged one"
        found = f"{damage} ({error})" if data else "an empty file"
        raise PolarguideError(path, expected=expected, found=found, remedy=remedy) from error


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """A member of an archive. It may decompress to more than it states; no more than that is ever decompressed.

    Raises:
        One of ``BROKEN``: it is damaged, or packed otherwise than NumPy packs: others decompress without a bound.
    """
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} is packed in a way that NumPy does not use")
    with archive.open(entry) as packed:
        return packed.read(entry.file_size)


def finite_numbers(where: object, array: object, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """An array of finite numbers in one of the shapes, as float64.

    Raises:
        PolarguideError: the array has another shape or type, or values that are not finite.
    """
    expected = f"finite numbers in shape {' or '.join('x'.join(map(str, shape)) for shape in shapes)}"
    try:
        numbers = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise wrong_camera(where, expected, f"something else ({error})") from None
    require_camera(numbers.shape in shapes, where, expected, array_size(numbers))
    require_camera(np.isfinite(numbers).all(), where, expected, "values that are not finite")
    return numbers


def array_header(stream: io.BytesIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type in the header of ``.npy``; the stream is then behind it.

    Raises:
        One of ``BROKEN``: there is no such header.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _array(data: bytes, kinds: str) -> NDArray[Any]:
    """Decode ``.npy``; a header that promises more than there is, is refused before memory is taken for it.

    ``kinds`` are the types of values that may be in it, as NumPy calls them.
    """
    stream = io.BytesIO(data)
    shape, dtype = array_header(stream)
    size = math.prod((dtype.itemsize, *shape))
    if dtype.hasobject or dtype.kind not in kinds or size > len(data) - stream.tell():
        raise ValueError("no complete array of numbers")
    stream.seek(0)
    return np.asarray(np.load(stream, allow_pickle=False))


_HDR_SIZE = re.compile(rb"[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n")
_EXR_MAGIC = b"\x76\x2f\x31\x01"


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
        pixels = _read_exr(path, "RGB", "Y")
    else:
        pixels = read_array(path)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    require(
        pixels.ndim == 3 and pixels.shape[2] in (1, 3) and 0 not in pixels.shape and pixels.dtype.kind == "f",
        path,
        expected="a picture of floating-point numbers with one or three channels",
        found=array_kind(pixels),
        remedy="Export the file again.",
    )
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), dtype=np.float32)


def _read_hdr(path: Path) -> NDArray[Any]:
    data = read_file(path)
    found = "an empty file" if not data else "a file of another kind"
    if (size := hdr_size(data)) is not None:
        found = f"one that is damaged or cut short (it ends after {len(data)} bytes)"
        # Run lengths reach 127 pixels with two bytes a channel: fewer bytes than this cannot be complete.
        if 0 < math.prod(size) <= min(LARGEST_PIXELS, 64 * len(data)):
            level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            try:
                pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
                if pixels is not None and pixels.dtype == np.float32 and pixels.ndim == 3:
                    return pixels[..., 2::-1]
            except cv2.error:
                pass
            finally:
                cv2.utils.logging.setLogLevel(level)
    raise damaged(path, "a complete Radiance HDR file", found)


def _read_exr(path: Path, *choices: Sequence[str]) -> NDArray[Any]:
    """The channels [H, W, C] of the first of the choices of names that an OpenEXR file has whole."""
    data = read_file(path)
    package = optional_import("OpenEXR", str(path))
    found = "an empty file" if not data else "one that is damaged, cut short or something else"
    if data.startswith(_EXR_MAGIC):
        try:
            exr_size(path)  # the package takes memory for all pixels as it opens them
            with in_utf8(path) as name, package.File(str(name), separate_channels=True) as file:
                channels = file.channels()
                for names in choices:
                    if all(name in channels for name in names):
                        planes = [np.asarray(channels[name].pixels, np.float32) for name in names]
                        return np.stack(planes, axis=-1)
        except Exception as error:  # the binding raises whatever C++ threw
            found = f"one that is damaged or cut short ({str(error).strip().splitlines()[0]})"
    names_wanted = ", or ".join(", ".join(names) for names in choices)
    raise damaged(path, f"a complete OpenEXR file with channels {names_wanted}", found)


def read_exr_channels(path: Path, groups: Sequence[Sequence[str]]) -> list[NDArray[np.float32]]:
    """Named channels of an OpenEXR file, a picture [H, W, C] for each group of names.

    Raises:
        PolarguideError: the file cannot be read, is damaged or lacks a channel, or the package OpenEXR is missing.
    """
    return [_read_exr(path, names) for names in groups]


def hdr_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the head of a Radiance file."""
    # The size stands behind the first empty line; before it, anything may look like one.
    size = _HDR_SIZE.match(data, data.find(b"\n\n", 0, 4096) + 2)
    return None if size is None or not data.startswith(b"#?") else (int(size[2]), int(size[1]))


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height of the last window in the headers of an OpenEXR file, of which nothing is decoded.

    Raises:
        ValueError: a window is larger than any picture.
        Exception: of several kinds, where the file is damaged.
        PolarguideError: the package OpenEXR is missing.
    """
    package = optional_import("OpenEXR", str(path))
    with in_utf8(path) as name, package.File(str(name), header_only=True) as file:
        windows = [part.header["dataWindow"] for part in file.parts]
    sizes = [tuple(int(high) - int(low) + 1 for low, high in zip(*window, strict=True)) for window in windows]
    width, height = max(sizes, key=math.prod)
    if width * height > LARGEST_PIXELS:
        raise ValueError(f"{width}x{height} pixels")
    width, height = sizes[-1]
    return width, height
