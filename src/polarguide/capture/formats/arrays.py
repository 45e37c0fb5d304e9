"""Read NumPy files; sizes are checked before allocation, and nothing is unpickled."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.integrity import damaged
from polarguide.capture.formats.pictures import read_file
from polarguide.errors import PolarguideError

_LARGEST_HEADER = 1 << 16
BROKEN = (
    *(ValueError, TypeError, EOFError, OSError, MemoryError, SyntaxError, RuntimeError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""What decoding raises for files that are damaged, encrypted, or lie; NumPy parses headers as Python."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LARGEST_ARCHIVE = 1 << 26
"""Largest uncompressed size of an ``.npz`` file of cameras, in bytes."""


def array_size(array: NDArray[Any]) -> str:
    """The shape of an array in words: "3x4"."""
    return "x".join(map(str, array.shape)) or "a single value"


def array_kind(array: NDArray[Any]) -> str:
    """Shape and type of an array in words, for messages."""
    return f"an array {array_size(array)} of {array.dtype}"


def wrong_camera(where: object, expected: str, found: str) -> PolarguideError:
    """The error that the numbers of a camera make no sense."""
    return PolarguideError(where, expected=expected, found=found, remedy="Export the cameras again.")


def read_array(path: Path) -> NDArray[Any]:
    """The array in an ``.npy`` file.

    Raises:
        PolarguideError: the file cannot be read, is truncated or no ``.npy`` file, or holds Python objects.
    """
    data = read_file(path)
    try:
        return _array(data)
    except BROKEN as error:
        found = "an empty file" if not data else f"{len(data)} bytes that are none"
        raise damaged(path, "a complete .npy file of numbers", found) from error


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays in an ``.npz`` file, by name.

    Raises:
        PolarguideError: the file cannot be read, is damaged or unfolds to more than cameras need.
    """
    data = read_file(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > _LARGEST_ARCHIVE:
                raise ValueError(f"an archive that unfolds to {size} bytes")
            return {
                entry.filename.removesuffix(".npy"): _array(_member(archive, entry))
                for entry in archive.infolist()
            }
    except zipfile.BadZipFile as error:
        found = "an empty file" if not data else f"one that cannot be unpacked ({error})"
    except BROKEN as error:
        found = f"a damaged one ({error})"
    raise damaged(path, "a complete .npz file of numbers", found)


def unpacked(data: bytes, names: Collection[str], largest: int) -> dict[str, NDArray[Any]]:
    """Arrays of an ``.npz`` file by name, those that are there; the others in it are not looked at.

    Args:
        data: the whole file. names: of the arrays. largest: bytes that any of them may take.

    Raises:
        One of ``BROKEN``: it is damaged, encrypted, or one of them is larger or holds no numbers.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        found = {}
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name in names and entry.filename.endswith(".npy"):
                if entry.file_size > largest + _LARGEST_HEADER:
                    raise ValueError(f"{name} of {entry.file_size} bytes")
                found[name] = _array(_member(archive, entry), "biufcSU")
        return found


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """A member of an archive. It may unfold to more than it says, so no more than that is ever unfolded.

    Raises:
        One of ``BROKEN``: it is damaged, or packed otherwise than NumPy packs: others unfold without a bound.
    """
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} is packed in a way that NumPy does not use")
    with archive.open(entry) as packed:
        return packed.read(entry.file_size)


def finite_numbers(where: object, array: object, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """An array of finite numbers in one of the shapes, as float64.

    Raises:
        PolarguideError: it has another shape or type, or values that are not finite.
    """
    expected = f"finite numbers in shape {' or '.join('x'.join(map(str, shape)) for shape in shapes)}"
    try:
        found = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise wrong_camera(where, expected, f"something else ({error})") from None
    if found.shape not in shapes:
        raise wrong_camera(where, expected, array_size(found))
    if not np.isfinite(found).all():
        raise wrong_camera(where, expected, "values that are not finite")
    return found


def _array(data: bytes, kinds: str = "biuf") -> NDArray[Any]:
    """Decode ``.npy``; a header that promises more than there is, is refused before memory is taken for it.

    ``kinds`` are the types of values that may be in it, as NumPy calls them.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    size = dtype.itemsize
    for length in shape:
        size *= length
    if dtype.hasobject or dtype.kind not in kinds or size > len(data) - stream.tell():
        raise ValueError("no complete array of numbers")
    stream.seek(0)
    return np.asarray(np.load(stream, allow_pickle=False))
