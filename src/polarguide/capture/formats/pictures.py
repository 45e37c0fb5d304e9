"""Decode photographs, masks, materials, linear radiance and NumPy arrays.

Sizes are checked before memory is allocated.
"""

from __future__ import annotations

import functools
import io
import math
import re
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from polarguide.capture.formats.stored import (
    BROKEN,
    JPEG_IN_TIFF,
    LARGEST_PIXELS,
    TIFFS,
    array_header,
    damaged,
    decode_stored,
    exr_size,
    hdr_size,
    picture_kind,
    read_picture,
    rescaled,
    stated_full_scale,
)
from polarguide.core.errors import PolarguideError, optional_import, require
from polarguide.core.files import in_utf8, read_file
from polarguide.optics.color import srgb_decode_array

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
    """Return the error for a camera with invalid numbers."""
    return PolarguideError(where, expected=expected, found=found, remedy="Export the cameras again.")


def require_camera(condition: object, where: object, expected: str, found: str) -> None:
    """Raise an error if the numbers of a camera do not meet a condition.

    Raises:
        PolarguideError: the condition is false.
    """
    if not condition:
        raise wrong_camera(where, expected, found)


def read_array(path: Path) -> NDArray[Any]:
    """Read the array of an ``.npy`` file.

    Raises:
        PolarguideError: the file cannot be read, is truncated, is not an ``.npy`` file, or has Python objects.
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
    """Read the arrays of an ``.npz`` file of cameras. The result has the arrays by name."""
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
        names: names of the requested arrays. Missing arrays are ignored. By default, all arrays are decoded.
        largest: largest uncompressed size of the file in bytes.
        kinds: types of values that are accepted, as NumPy's kind codes.
        expected: field of the error.
        remedy: field of the error.

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
    """Decompress a member of an archive. At most as many bytes are decompressed as its header states.

    Raises:
        One of ``BROKEN``: the member is damaged, or its compression is not one that NumPy writes.
    """
    if entry.compress_type not in _METHODS:
        raise ValueError(f"{entry.filename} has a compression that NumPy does not use")
    with archive.open(entry) as packed:
        return packed.read(entry.file_size)


def finite_numbers(where: object, array: object, shapes: tuple[tuple[int, ...], ...]) -> NDArray[np.float64]:
    """Convert an array of finite numbers to float64 after a check of its shape.

    Raises:
        PolarguideError: the shape is not in ``shapes``, the values are not numbers, or a value is not finite.
    """
    expected = f"finite numbers in shape {' or '.join('x'.join(map(str, shape)) for shape in shapes)}"
    try:
        numbers = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise wrong_camera(where, expected, f"something else ({error})") from None
    require_camera(numbers.shape in shapes, where, expected, array_size(numbers))
    require_camera(np.isfinite(numbers).all(), where, expected, "values that are not finite")
    return numbers


def _array(data: bytes, kinds: str) -> NDArray[Any]:
    """Decode the content of an ``.npy`` file.

    If the file has fewer values than its header states, it is refused before memory is allocated. ``kinds`` has the
    types of values that are accepted, as NumPy's kind codes.
    """
    stream = io.BytesIO(data)
    shape, dtype = array_header(stream)
    size = math.prod((dtype.itemsize, *shape))
    if dtype.hasobject or dtype.kind not in kinds or size > len(data) - stream.tell():
        raise ValueError("no complete array of numbers")
    stream.seek(0)
    return np.asarray(np.load(stream, allow_pickle=False))


_EXR_MAGIC = b"\x76\x2f\x31\x01"


def read_radiance(path: Path) -> NDArray[np.float32]:
    """Read a linear picture. Values may be negative or larger than 1, and are not changed.

    Args:
        path: Radiance ``.hdr``, OpenEXR ``.exr`` (package OpenEXR) or ``.npy`` with [H, W], [H, W, 1] or [H, W, 3].

    Returns:
        [H, W, 3] float32, RGB. A gray picture becomes three equal channels.

    Raises:
        PolarguideError: the file cannot be read, is damaged, is of an unsupported kind, or a package is missing.
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
    """Read the color or gray channels of an OpenEXR file, [H, W, C].

    The file may name its channels in several ways. The first set of names is used whose channels all exist.

    Raises:
        PolarguideError: the file cannot be read, is damaged, or has no such channels. Or the package OpenEXR is
            missing.
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
                        return np.stack(
                            [np.asarray(channels[name].pixels, np.float32) for name in names], axis=-1
                        )
        except Exception as error:  # any C++ error
            found = f"one that is damaged or cut short ({str(error).strip().splitlines()[0]})"
    channels_text = ", or ".join(", ".join(names) for names in choices)
    raise damaged(path, f"a complete OpenEXR file with channels {channels_text}", found)


TRANSFERS = ("linear", "srgb")

FULL_CODE = 65535
"""Code that represents the linear intensity 1."""
MOST_MATERIAL = 255
MATERIAL_REMEDY = (
    "Write the numbers 0 (unknown), 1 (dielectric) and 2 (metal), not gray levels. Define other numbers in materials "
    "of scene.json."
)


def decode_picture(path: Path, data: bytes, *, keep_floats: bool = False) -> NDArray[Any]:
    """Decode a photograph.

    Args:
        path: path of the file for messages.
        data: content of a PNG, JPEG, WebP, HEIC, BMP, PGM, PPM or TIFF file, gray or color. A channel has 8 or 16 bits.
            Files with fewer bits, see ``stated_full_scale``, are rescaled to 8 or 16. A TIFF file of floating-point
            numbers from 0 to 1 is converted to 16 bits, and larger numbers become full scale. An opaque alpha channel
            is removed. An orientation tag is ignored, because poses refer to the stored pixels.
        keep_floats: return floating-point numbers without conversion, also numbers above 1.

    Returns:
        Stored pixels [H, W, 3] uint8 or uint16, RGB, or float32 if ``keep_floats``. A gray picture has three equal
        channels.

    Raises:
        PolarguideError: the file is damaged, truncated, of an unsupported kind, or has transparent pixels.
    """
    pixels = decode_stored(path, data)
    full = stated_full_scale(path, io.BytesIO(data), pixels)
    if pixels.dtype.kind == "f":
        _require_finite(path, pixels)
        if keep_floats:
            pixels = np.maximum(pixels, 0).astype(np.float32)
        else:
            require_full_scale(path, pixels)
            pixels = codes_of_floats(pixels)
    elif full is not None:
        pixels = rescaled(pixels, full)
    require(
        pixels.dtype in (np.uint8, np.uint16, np.float32),
        path,
        expected="a picture with 8 or 16 bits a channel",
        found=f"values of type {pixels.dtype}",
        remedy="Save it as 16-bit PNG with value 65535 for linear intensity 1.",
    )
    clear = 0.0 if pixels.shape[2:] != (4,) else float((pixels[..., 3] < np.iinfo(pixels.dtype).max).mean())
    require(
        not clear,
        path,
        expected="an opaque picture",
        found=f"{clear:.1%} of it transparent",
        remedy="Save it without transparency, and mark unusable pixels in masks/ or invalid/.",
    )
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1])


_UNIT_FLOATS = "floating-point values from 0 to 1, where 1 is full scale"
_DIVIDE = "Divide by the value at which the camera saturates, or save 16-bit whole numbers."


def _require_finite(path: Path, pixels: NDArray[Any]) -> None:
    require(
        bool(np.isfinite(pixels).all()),
        path,
        expected=_UNIT_FLOATS,
        found="values that are not finite",
        remedy=_DIVIDE,
    )


def require_full_scale(path: Path, pixels: NDArray[Any]) -> None:
    """Check that floating-point values have the full scale 1. Their median is then at most 1.

    Raises:
        PolarguideError: most values exceed 1.
    """
    require(
        float(np.median(pixels)) <= 1.0,
        path,
        expected=_UNIT_FLOATS,
        found=f"up to {float(pixels.max()):g}",
        remedy=_DIVIDE,
    )


def codes_of_floats(pixels: NDArray[Any]) -> NDArray[np.uint16]:
    """Convert linear intensities to 16-bit codes. Values outside [0, 1] are clipped."""
    # Half precision ends at 65504, below the largest code, so double precision is used.
    return np.rint(np.clip(pixels.astype(np.float64), 0.0, 1.0) * FULL_CODE).astype(np.uint16)


def decode_mask(path: Path, data: bytes, *, any_value: bool) -> NDArray[np.bool_]:
    """Decode a mask picture into [H, W] bool.

    Args:
        path: path of the file for messages.
        data: content of the file.
        any_value: if True, the mask contains the pixels with a nonzero channel. If False, it contains the pixels whose
            value is at least half of the maximum. This supports files with the values 0 and 1, files with 0 and 255,
            and soft edges.

    Raises:
        PolarguideError: the file is damaged, truncated, of an unsupported kind, or has two different masks.
    """
    pixels = decode_stored(path, data)
    gray = pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=2)
    mask = np.asarray(gray > 0)
    if not any_value:
        _require_two_levels(path, gray)
        mask &= 2.0 * gray >= float(gray.max())
    _require_one_mask(path, pixels, mask)
    return mask


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a foreground mask [H, W] from a picture.

    A pixel is foreground if its value is at least half of the largest value. In a picture with transparent pixels, a
    pixel is foreground if it is at least half opaque.
    """
    data = read_picture(path)
    pixels = decode_stored(path, data)
    if pixels.ndim == 3 and pixels.shape[2] in (2, 4) and pixels.dtype.kind == "u":
        alpha = pixels[..., -1]
        full = int(np.iinfo(pixels.dtype).max)
        if (alpha < full).any():
            return np.asarray(2 * alpha.astype(np.int64) >= full)
    return decode_mask(path, data, any_value=False)


_BLACK = 0.04  # largest value of compressed black, relative to the maximum of a mask
_SMALL_AREA = 1e-3  # share of a picture; areas of one gray in a soft edge are smaller


def _require_two_levels(path: Path, gray: NDArray[Any]) -> None:
    """Refuse a picture that labels several objects instead of the foreground.

    Small labels would be taken for background. A picture has labels if it has uniform areas of more than two grays, of
    which one is less than half of the maximum. The grays of soft edges change from pixel to pixel.

    Raises:
        PolarguideError: the picture has labels.
    """
    levels = gray.astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    flat = cv2.erode(levels, around) == cv2.dilate(levels, around)
    largest = float(levels.max())
    labels = flat & (levels > _BLACK * largest) & (2 * levels < largest)
    _, counts = np.unique(levels[flat], return_counts=True)
    if labels.mean() > _SMALL_AREA and (counts > _SMALL_AREA * counts.sum()).sum() > 2:
        levels_text = ", ".join(f"{level:g}" for level in np.unique(levels[labels])[:4])
        raise PolarguideError(
            path,
            expected="a mask of two levels, background and object",
            found=f"areas of {levels_text} and a maximum of {largest:g}, which are labels of several objects",
            remedy="Save it as a gray picture, white where the mask is.",
        )


def _require_one_mask(path: Path, pixels: NDArray[Any], mask: NDArray[np.bool_]) -> None:
    """Refuse a picture whose colors and whose transparency show two different masks.

    Raises:
        PolarguideError: the two masks differ.
    """
    if pixels.shape[2:] != (4,) or pixels.dtype.kind != "u":
        return
    opaque = pixels[..., 3] > np.iinfo(pixels.dtype).max // 2
    require(
        opaque.all() or (opaque == mask).all(),
        path,
        expected="a mask without transparency",
        found=f"{1 - float(opaque.mean()):.1%} of it transparent, in contradiction to its colors",
        remedy="Save it as a gray picture, white where the mask is.",
    )


def decode_materials(path: Path, data: bytes) -> NDArray[np.uint8]:
    """Decode a picture of material labels, [H, W].

    The label 0 means unknown, 1 dielectric and 2 metal. ``scene.json`` defines the other labels.

    Raises:
        PolarguideError: the file is damaged, truncated, of an unsupported kind or lossy. Or it has a value above 255.
    """
    pixels = decode_stored(path, data)
    require(
        not _loses_detail(data),
        path,
        expected="a lossless picture, such as PNG",
        found="a lossy compression (JPEG, HEIC, WebP), which changes the numbers of materials",
        remedy=f"Save it as PNG. {MATERIAL_REMEDY}",
    )
    gray = pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=2)
    require(
        int(gray.max(initial=0)) <= MOST_MATERIAL,
        path,
        expected=f"the numbers of materials, up to {MOST_MATERIAL}",
        found=f"{int(gray.max())}",
        remedy=MATERIAL_REMEDY,
    )
    return np.asarray(gray, np.uint8)


def linear_codes(pixels: NDArray[Any], transfer: str) -> NDArray[Any]:
    """Convert stored 8- or 16-bit values to the codes ``round(65535 * linear intensity)``, uint16.

    Floating-point numbers are linear intensities. Their codes are floating-point numbers in the same unit.
    """
    if pixels.dtype.kind == "f":
        return pixels * np.float32(FULL_CODE)
    if pixels.dtype == np.uint16 and transfer == "linear":
        return pixels.astype(np.uint16, copy=False)
    return _table(int(np.iinfo(pixels.dtype).max), transfer)[pixels]


@functools.cache
def _table(full: int, transfer: str) -> NDArray[np.uint16]:
    """Compute the linear code of each stored value from 0 to ``full``."""
    levels = np.arange(full + 1) / full
    if transfer == "srgb":
        levels = srgb_decode_array(levels)
    return np.rint(levels * FULL_CODE).astype(np.uint16)


def _loses_detail(data: bytes) -> bool:
    """Return True if the content of a picture file has a lossy compression."""
    kind = picture_kind(data)
    if kind == "WebP":
        chunk = re.search(rb"VP8[ L]", data)  # first chunk of pixels
        return chunk is not None and chunk[0] == b"VP8 "
    if kind in TIFFS:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            return int(tiff.pages.first.compression) in JPEG_IN_TIFF
    return kind in ("JPEG", "HEIF")
