"""Read NumPy files and linear pictures (.hdr, .exr, .npy). Sizes are checked before memory is allocated."""

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

BROKEN = (
    *(ValueError, TypeError, EOFError, OSError, MemoryError, SyntaxError, RuntimeError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Errors of decoders for damaged, encrypted or contradictory files. NumPy parses headers as Python code."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LARGEST_ARCHIVE = 1 << 26
"""Largest uncompressed size of an ``.npz`` file of cameras, in bytes."""


def array_size(array: NDArray[Any]) -> str:
    """Format the shape of an array, such as "3x4"."""
    return "x".join(map(str, array.shape)) or "a single value"


def array_kind(array: NDArray[Any]) -> str:
    """Describe the shape and type of an array for messages."""
    return f"an array {array_size(array)} of {array.dtype}"


def wrong_camera(where: object, expected: str, found: str) -> PolarguideError:
    """Return the error of invalid numbers of a camera."""
    return PolarguideError(where, expected=expected, found=found, remedy="Export the cameras again.")


def require_camera(condition: object, where: object, expected: str, found: str) -> None:
    """Check a condition on the numbers of a camera.

    Raises:
        PolarguideError: the condition does not hold.
    """
    if not condition:
        raise wrong_camera(where, expected, found)


def read_array(path: Path) -> NDArray[Any]:
    """Read the array of an ``.npy`` file.

    Raises:
        PolarguideError: the file cannot be read, is truncated or of another kind, or has Python objects.
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
    """Read the arrays of an ``.npz`` file of cameras by name; see ``decode_arrays``."""
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
        path: path of the file for messages.
        data: content of the file.
        names: names of the requested arrays; missing arrays are ignored. Default: all arrays.
        largest: largest uncompressed size in bytes.
        kinds: accepted types of values as NumPy's kind codes.
        expected, remedy: fields of the error.

    Raises:
        PolarguideError: the file is damaged or encrypted, or decompresses to more than ``largest`` bytes.
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
    """Decompress a member of an archive, but no more bytes than its header states.

    Raises:
        One of ``BROKEN``: the member is damaged, or has a compression without such a bound, which NumPy does not use.
    """
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} has a compression that NumPy does not use")
    with archive.open(entry) as packed:
        return packed.read(entry.file_size)


def finite_numbers(where: object, array: object, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """Convert an array of finite numbers in one of the shapes to float64.

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
    """Read shape and type from the header of ``.npy``; the stream ends up at the values.

    Raises:
        One of ``BROKEN``: the header is invalid.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _array(data: bytes, kinds: str) -> NDArray[Any]:
    """Decode ``.npy``. A header that states more values than the file has is refused before memory is allocated.

    ``kinds`` are the accepted types of values as NumPy's kind codes.
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
    """Read a linear picture. Values may be negative or above 1 and stay as they are.

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
        pixels = read_exr(path, "RGB", "Y")
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
    """Read a Radiance picture, [H, W, 3]."""
    data = read_file(path)
    found = "an empty file" if not data else "a file of another kind"
    if (size := hdr_size(data)) is not None:
        found = f"one that is damaged or cut short (it ends after {len(data)} bytes)"
        # Compression is at most 127 pixels in two bytes per channel.
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


def read_exr(path: Path, *choices: Sequence[str]) -> NDArray[Any]:
    """Read named channels [H, W, C] of an OpenEXR file: the first of the choices that is complete.

    Raises:
        PolarguideError: the file cannot be read, is damaged or lacks channels, or the package OpenEXR is missing.
    """
    data = read_file(path)
    package = optional_import("OpenEXR", str(path))
    found = "an empty file" if not data else "one that is damaged, cut short or something else"
    if data.startswith(_EXR_MAGIC):
        try:
            exr_size(path)  # the package allocates all pixels when it opens them
            with in_utf8(path) as name, package.File(str(name), separate_channels=True) as file:
                channels = file.channels()
                for names in choices:
                    if all(name in channels for name in names):
                        planes = [np.asarray(channels[name].pixels, np.float32) for name in names]
                        return np.stack(planes, axis=-1)
        except Exception as error:  # any C++ error
            found = f"one that is damaged or cut short ({str(error).strip().splitlines()[0]})"
    channels_text = ", or ".join(", ".join(names) for names in choices)
    raise damaged(path, f"a complete OpenEXR file with channels {channels_text}", found)


def hdr_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height in the header of a Radiance file."""
    # The size follows the first empty line.
    size = _HDR_SIZE.match(data, data.find(b"\n\n", 0, 4096) + 2)
    return None if size is None or not data.startswith(b"#?") else (int(size[2]), int(size[1]))


def exr_size(path: Path) -> tuple[int, int]:
    """Return width and height of the last window in the headers of an OpenEXR file without decoding it.

    Raises:
        ValueError: a window is larger than any picture.
        Exception: the file is damaged; several kinds.
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
