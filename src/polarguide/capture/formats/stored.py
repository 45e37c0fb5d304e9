"""Read and decode picture files: kinds, sizes, damage and stored values.

Some decoders refuse truncated files, and others return gray or old rows for the missing part. The check of the
structure gives the same result for every decoder.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.WebPImagePlugin import WebPImageFile

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import LARGEST_FILE, in_utf8, read_file

_KINDS = re.compile(
    rb"(?P<PNG>\x89PNG\r\n\x1a\n)|(?P<JPEG>\xff\xd8)|(?P<TIFF>II\*\0|MM\0\*)|(?P<BigTIFF>II\+\0|MM\0\+)"
    rb"|(?P<BMP>BM)|(?P<PNM>P[56])|(?P<WebP>RIFF.{4}WEBP)"
    rb"|(?P<HEIF>.{4}ftyp(?:heic|heix|hevc|heim|heis|mif1|msf1|avif|avis))",
    re.DOTALL,
)
"""Pattern that recognizes kinds of picture files by their first bytes."""
TIFFS = ("TIFF", "BigTIFF")
# Markers of JPEG files. In scan data, 0xFF is followed by 0 (a stuffed byte) or by 0xD0-0xD7 (a restart).
_START_OF_SCAN = b"\xff\xda"
_END_OF_IMAGE = b"\xff\xd9"
ORIENTATION = 274
# Largest number of scans of a progressive JPEG file. Encoders write about ten. Even an empty scan takes time to decode.
_MOST_SCANS = 200
LARGEST_PIXELS = 150_000_000
"""Largest number of pixels of a picture. A larger picture is refused before memory is allocated."""


def damaged(path: Path, expected: str, found: str) -> PolarguideError:
    """Return the error for a file that cannot be decoded."""
    return PolarguideError(path, expected=expected, found=found, remedy="Copy or export the file again.")


def picture_kind(data: bytes) -> str:
    """Return the kind of a picture file according to its first bytes: PNG, JPEG, TIFF, BigTIFF, BMP, PNM, WebP or HEIF.

    Return an empty text for any other file.
    """
    match = _KINDS.match(data)
    return "" if match is None else str(match.lastgroup)


def find_damage(data: bytes) -> str | None:
    """Describe the damage in the structure of a picture file. Return None if the structure is complete.

    Args:
        data: content of the file.

    Returns:
        A noun phrase for the field ``found`` of an error, such as "an empty file" or "a PNG file cut short".
    """
    kind = picture_kind(data)
    if kind:
        return _DAMAGE[kind](data)
    return "a file of another kind" if data else "an empty file"


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in the header of a picture file.

    Return None if the header is invalid, or if decoders interpret it differently.
    """
    kind = picture_kind(data)
    if kind == "PNG":
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" and len(data) >= 24 else None
    if kind in TIFFS:
        return tiff_size(io.BytesIO(data))
    if kind == "HEIF":
        return _heif_size(data)
    head = _pillow_head(data)
    return None if head is None else head.size


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind, start and end of each chunk of a PNG file. The last chunk may end beyond the file."""
    at = 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield kind, at, at + 12 + length
        at += 12 + length


def png_chunk(data: bytes, kind: bytes) -> bytes | None:
    """Return the content of the first chunk of a kind in a PNG file. Return None if there is no such chunk."""
    return next((data[at + 8 : end - 4] for name, at, end in png_chunks(data) if name == kind), None)


def significant_bits(data: bytes) -> int | None:
    """Return the number of significant bits that a PNG file states in its chunk sBIT. Return None without this chunk.

    If the colors have different numbers, return the largest one.
    """
    stated = png_chunk(data, b"sBIT")
    return max(stated[:3] if len(stated) > 2 else stated[:1]) if stated else None


def _png_damage(data: bytes) -> str | None:
    """Describe the damage in the chunks of a PNG file, such as a wrong checksum. Return None if they are complete."""
    if declared_size(data) is None and len(data) >= 24:
        return "a PNG file that does not begin with its size"
    for kind, at, end in png_chunks(data):
        if end > len(data):
            break
        (stored,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stored:
            return f"a damaged PNG file (wrong checksum at byte {at})"
        if kind == b"acTL":  # decoders return different frames
            return "an animated PNG file"
        if kind == b"IEND":
            return None
    return f"a PNG file cut short (it ends after {len(data)} bytes)"


def _jpeg_damage(data: bytes) -> str | None:
    """Describe the damage in the structure of a JPEG file. Return None if it is complete.

    The file is damaged if it has no size, no end-of-image marker after its first scan, or too many scans.
    """
    picture = _pillow_head(data)
    start = 2 if picture is None else picture.fp.tell()
    end = data.find(_END_OF_IMAGE, start)
    scans = data.count(_START_OF_SCAN, start, end) + 1
    if end < 0:
        return f"a JPEG file cut short (it ends after {len(data)} bytes)"
    if scans > _MOST_SCANS:
        return f"a JPEG file of {scans} scans"
    return "a JPEG file without a size" if picture is None else None


_PILLOW: dict[str, Any] = {
    "BMP": BmpImageFile,
    "JPEG": JpegImageFile,
    "PNM": PpmImageFile,
    "WebP": WebPImageFile,
}


def opened_picture(data: bytes) -> Any:
    """Open a BMP, JPEG, PGM, PPM or WebP file with Pillow without decoding its pixels.

    ``data`` may be the start of a file, except for a WebP file, which must be whole.

    Raises:
        Exception: the file is damaged. Pillow raises several kinds of errors.
    """
    return _PILLOW[picture_kind(data)](io.BytesIO(data))


def _pillow_head(data: bytes) -> Any:
    """Open a file with ``opened_picture``. Return None if the file is damaged or of an unsupported kind."""
    with contextlib.suppress(Exception):
        return opened_picture(data)
    return None


def pnm_full_scale(data: bytes) -> int | None:
    """Return the stored value of full scale in the header of a PGM or PPM file. Return None for any other file."""
    picture = _pillow_head(data) if picture_kind(data) == "PNM" else None
    if picture is None:
        return None
    decoder, _, _, mode = picture.tile[0]
    return int(mode[1]) if decoder == "ppm" else {"I;16B": 65535}.get(mode, 255)


def pnm_damage(data: bytes) -> str | None:
    """Describe the damage in the structure of a PGM or PPM file. Return None if it is complete."""
    picture = _pillow_head(data)
    full = pnm_full_scale(data)
    if picture is None or full is None:
        return "a PGM or PPM file without a size and full scale"
    samples = math.prod(picture.size) * len(picture.getbands())
    end = picture.tile[0][2] + samples * (1 if full < 256 else 2)
    return None if end <= len(data) else f"a PGM or PPM file cut short (it ends after {len(data)} bytes)"


def pillow_damage(data: bytes) -> str | None:
    """Describe the damage in the structure of a BMP or WebP file. Return None if it is complete."""
    name = picture_kind(data)
    end = 0
    try:
        picture = opened_picture(data)
        if isinstance(picture, BmpImageFile):
            tile: Any = picture.tile[0]
            _, (*_, height), start, (stored, row, _) = tile
            if picture.info["compression"] or ";" in stored:
                return "a BMP file without 8, 24 or 32 bits a pixel, not compressed"
            if start != int.from_bytes(data[10:14], "little"):
                return "a BMP file without the place of its pixels, which decoders read differently"
            end = start + row * height
        elif picture.n_frames > 1:
            return "an animated WebP file"
    except Image.DecompressionBombError:
        return "a WebP file with more pixels than any camera has"
    except Exception:
        end = len(data) + 1
    return (
        None if end <= len(data) else f"a {name} file cut short or damaged (it ends after {len(data)} bytes)"
    )


_AVIF = (b"avif", b"avis")
_TURN = re.compile(rb"\0\0\0\x09irot(.)", re.DOTALL)
"""Pattern that finds the rotation of a HEIC file for display, in quarter turns counter-clockwise (ISO/IEC 23008-12)."""
_MIRROR = b"\0\0\0\x09imir"
_ORIENTATION_OF_TURNS = (1, 8, 3, 6)
"""EXIF orientation for 0, 1, 2 and 3 quarter turns counter-clockwise."""
HIGH_RANGE = {16: "PQ", 18: "HLG"}
"""Names of transfer characteristics (ITU-T H.273) that cannot be converted to linear light."""


def _opened_heif(data: bytes, where: str) -> Any:
    """Open a HEIC file with pillow-heif without decoding its pixels.

    Raises:
        PolarguideError: pillow-heif is not installed. The message begins with ``where``.
        Exception: the file is damaged. There are several kinds of errors.
    """
    library = optional_import("pillow_heif", where)
    return library.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, bgr_mode=True)


def _heif_turns(data: bytes) -> int:
    """Return the number of quarter turns counter-clockwise by which a HEIC file is rotated for display."""
    return max((turn[0] & 3 for turn in _TURN.findall(data)), default=0)


def heif_orientation(data: bytes) -> int:
    """Return the EXIF orientation of a HEIC file. The orientation tag in the file is informative only."""
    return _ORIENTATION_OF_TURNS[_heif_turns(data)]


def _heif_size(data: bytes) -> tuple[int, int] | None:
    """Return the stored width and height of a HEIC file, before rotation for display.

    Return None if the file is damaged, or if pillow-heif is not installed.
    """
    with contextlib.suppress(Exception):
        width, height = _opened_heif(data, "size").size
        return (height, width) if _heif_turns(data) % 2 else (width, height)
    return None


def heif_damage(data: bytes) -> str | None:
    """Describe the damage or an unsupported feature of a HEIC or AVIF file. Return None if it can be decoded.

    Without pillow-heif, damage is not found.
    """
    if data[8:12] in _AVIF:
        return "an AVIF file"
    if _MIRROR in data:
        return "a HEIC file that is mirrored for display"
    if len(set(_TURN.findall(data))) > 1:
        return "a HEIC file of pictures that are rotated differently"
    try:
        opened = _opened_heif(data, "damage")
    except PolarguideError:  # reported when the pixels are read
        return None
    except Exception as error:
        return f"a HEIC file that is damaged or cut short ({' '.join(str(error).split())[:200]})"
    transfer, _ = heif_colors(data)
    if transfer in HIGH_RANGE:
        return f"a HEIC file of high dynamic range ({HIGH_RANGE[transfer]})"
    return f"a HEIC file of {len(opened)} pictures" if len(opened) > 1 else None


def heif_tags(data: bytes) -> bytes:
    """Return the EXIF block of a HEIC file. It is empty if there is no block, or if pillow-heif is not installed."""
    with contextlib.suppress(Exception):  # reported when the pixels are read
        return bytes(_opened_heif(data, "EXIF").info.get("exif") or b"")
    return b""


def heif_colors(data: bytes) -> tuple[int | None, bytes | None]:
    """Return the transfer characteristics and the ICC profile of a HEIC file. Each is ``None`` if the file lacks it.

    Raises:
        Exception: the file is damaged, or pillow-heif is not installed. There are several kinds of errors.
    """
    info = _opened_heif(data, "color").info
    return (info.get("nclx_profile") or {}).get("transfer_characteristics"), info.get("icc_profile")


def heif_pixels(path: Path, data: bytes) -> NDArray[Any]:
    """Decode the stored picture of a HEIC file, before rotation for display.

    Args:
        path: path of the file for messages.
        data: content of the file, after ``find_damage``.

    Returns:
        [H, W, C] in OpenCV's order of channels. The type is uint8, or uint16 for files of more than 8 bits. The largest
        value of the type is full scale.

    Raises:
        PolarguideError: pillow-heif is not installed.
        Exception: the file is damaged. There are several kinds of errors.
    """
    opened = _opened_heif(data, str(path))
    pixels = np.ascontiguousarray(np.rot90(np.asarray(opened), -_heif_turns(data)))
    if pixels.dtype == np.uint8:
        return pixels
    bits = int(opened.info["bit_depth"])
    # The decoder shifts values to the top of 16 bits.
    return rescaled(pixels >> (16 - bits), (1 << bits) - 1)


def rescaled(pixels: NDArray[Any], full: int) -> NDArray[Any]:
    """Rescale integers so that the value ``full`` becomes the largest value of their type."""
    largest = np.iinfo(pixels.dtype).max
    table = np.rint(np.minimum(np.arange(largest + 1) * (largest / full), largest)).astype(pixels.dtype)
    return np.asarray(table[pixels])


# tifffile logs unusual features of files. Relevant ones are errors here.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_GRAY = 1
_RGB = 2
_PALETTE = 3
_YCBCR = 6
_WHITE_IS_ZERO = 0
_SAMPLES = {_GRAY: 1, _RGB: 3, _PALETTE: 1, _YCBCR: 3}
JPEG_IN_TIFF = (6, 7)
"""Compressions of TIFF whose decoders convert the colors to RGB."""
_NO_PICTURE = 1 | 4
"""Bits of the tag NewSubfileType that mark a thumbnail or a transparency mask."""
_OLD_SUBFILE_TYPE = 255
_OLD_REDUCED = 2
"""Value of the older tag SubfileType that marks a thumbnail."""
_MOST_PICTURES = 1000


class UnreadableTiffError(ValueError):
    """Error for a TIFF file that is not an ordinary picture. Its text is a noun phrase with the reason."""


def decode_tiff(data: bytes) -> NDArray[Any]:
    """Decode the picture of a TIFF or BigTIFF file without rotation and scaling.

    Args:
        data: content of the file.

    Returns:
        [H, W] or [H, W, C] in OpenCV's order of channels (blue, green, red, alpha), 8- or 16-bit whole numbers or
        floating-point numbers.

    Raises:
        UnreadableTiffError: the file has several pictures, or its samples are not gray or RGB.
        Exception: the file is damaged. tifffile raises several kinds of errors.
    """
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = _only_page(file)
        samples, transparent = _sample_layout(page)
        pixels = np.asarray(page.asarray(maxworkers=1))
        size = (page.imagelength, page.imagewidth)
        bits = int(page.bitspersample)
        colors = page.colormap if page.photometric == _PALETTE else None
    if pixels.ndim == 3 and page.planarconfig == 2:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.shape != (size if samples == 1 else (*size, samples)):
        raise UnreadableTiffError("a TIFF file of several layers")
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if bits == 1 and pixels.dtype.kind in "bu":
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    if colors is not None:
        # Palettes have 16 bits. Entries of 8-bit colors are multiples of 257.
        pixels = np.rint(np.asarray(colors).T[pixels] / 257).astype(np.uint8)
    if transparent and samples == 2:
        return pixels[..., [0, 0, 0, 1]]
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3]] if transparent else pixels[..., ::-1]
    return pixels


_LARGEST = 281
_SIDES = [256, 257]
_PLAIN_TYPES = (3, 4)
"""Types of the tags for width and height that all decoders support, which are unsigned integers of 16 and 32 bits."""
_LONG8 = 16


def tiff_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return the width and height in the header of a TIFF or BigTIFF file. Return None as ``_plain_size`` does."""
    with (
        contextlib.suppress(Exception),
        tifffile.TiffFile(file) as opened,
    ):  # tifffile raises many kinds of errors
        return _plain_size(opened)
    return None


def _plain_size(file: tifffile.TiffFile) -> tuple[int, int] | None:
    """Return the width and height of an open TIFF file.

    Return None if the tag of a side is missing, duplicate or of an unusual type.
    """
    tags = file.pages.first.tags
    sides = [tag for code in _SIDES for tag in tags.getall(code) or ()]
    types = (*_PLAIN_TYPES, _LONG8) if file.is_bigtiff else _PLAIN_TYPES
    if [tag.code for tag in sides] != _SIDES or any(tag.dtype not in types for tag in sides):
        return None
    return int(sides[0].value), int(sides[1].value)


def tiff_damage(data: bytes) -> str | None:
    """Describe the damage in the structure of a TIFF or BigTIFF file. Return None if it is complete."""
    name = picture_kind(data)
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            page = file.pages.first
            (entries,) = struct.unpack_from(file.tiff.tagnoformat, data, page.offset)
            spans = zip(page.dataoffsets, page.databytecounts, strict=False)
            # tifffile skips entries whose values are outside the file.
            complete = len(page.tags) == entries and all(at + size <= len(data) for at, size in spans)
            if _plain_size(file) is None:
                return f"a {name} file without one plain size"
    except Exception:  # tifffile raises several kinds of errors
        complete = False
    return None if complete else f"a {name} file cut short (it ends after {len(data)} bytes)"


def tiff_full_scale(file: tifffile.TiffFile) -> int | None:
    """Return the full scale that a TIFF file states. Return None if it is the largest value of the type.

    It follows from the number of bits of a sample, or from the tag MaxSampleValue if its value is a power of two minus
    1. Other values of this tag may be the largest value in the picture.
    """
    page = file.pages.first
    kind = page.dtype
    bits = int(page.bitspersample)
    if kind is None or kind.kind != "u" or bits == 1 or page.photometric == _PALETTE:
        return None
    stated = page.tags.valueof(_LARGEST, 0)
    largest = max(stated) if isinstance(stated, tuple) else int(stated)
    full = (1 << bits) - 1
    if 0 < largest < full and largest & (largest + 1) == 0:
        full = largest
    return full if full < np.iinfo(kind).max else None


def _only_page(file: tifffile.TiffFile) -> tifffile.TiffPage:
    """Return the page of a TIFF file that has the picture.

    Raises:
        UnreadableTiffError: the file has several pictures, or its first page is a thumbnail.
    """
    pages = [page.aspage() for page in itertools.islice(file.pages, _MOST_PICTURES)]
    pictures = [
        page
        for page in pages
        if not page.subfiletype & _NO_PICTURE and page.tags.valueof(_OLD_SUBFILE_TYPE) != _OLD_REDUCED
    ]
    stacked = int((file.imagej_metadata or {}).get("images", 1))
    if len(pictures) > 1 or stacked > 1:
        raise UnreadableTiffError(f"a TIFF file of {max(len(pictures), stacked)} pictures")
    if not pictures or pictures[0] is not pages[0]:
        raise UnreadableTiffError("a TIFF file that begins with a thumbnail of its picture")
    return pictures[0]


def _sample_layout(page: tifffile.TiffPage) -> tuple[int, bool]:
    """Return the number of samples per pixel, and True if the last sample is transparency.

    Raises:
        UnreadableTiffError: the samples are neither gray nor RGB.
    """
    meaning = int(page.photometric)
    samples = int(page.samplesperpixel)
    if meaning == _WHITE_IS_ZERO:
        raise UnreadableTiffError("a TIFF file whose white is 0")
    if meaning not in _SAMPLES or (meaning == _YCBCR and int(page.compression) not in JPEG_IN_TIFF):
        name = getattr(page.photometric, "name", str(meaning)).lower()
        raise UnreadableTiffError(f"a TIFF file of the color model {name}")
    more = samples - _SAMPLES[meaning]
    extra = tuple(int(kind) for kind in page.extrasamples)
    # Many writers leave the fourth sample of RGB unspecified. A second sample of gray may be anything.
    alpha = more == 1 and meaning in (_GRAY, _RGB) and (meaning == _RGB or extra[:1] in {(1,), (2,)})
    if more and not alpha:
        kind = "gray" if meaning == _GRAY else "color"
        raise UnreadableTiffError(f"a TIFF file of {samples} samples a pixel, more than {kind} has")
    integers = page.dtype is not None and page.dtype.kind in "bu" and page.dtype.itemsize <= 2
    if page.dtype is None or not (integers or page.dtype.kind == "f"):
        raise UnreadableTiffError(f"a TIFF file with values of type {page.dtype}")
    return samples, alpha


_DAMAGE = {
    "PNG": _png_damage,
    "JPEG": _jpeg_damage,
    "TIFF": tiff_damage,
    "BigTIFF": tiff_damage,
    "BMP": pillow_damage,
    "WebP": pillow_damage,
    "PNM": pnm_damage,
    "HEIF": heif_damage,
}


BROKEN = (
    *(ValueError, TypeError, EOFError, OSError, MemoryError, SyntaxError, RuntimeError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Errors that decoders raise for damaged, encrypted or contradictory files. NumPy parses headers as Python code."""


def array_header(stream: io.BytesIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the shape and type of the values from the header of an ``.npy`` stream.

    Afterwards, the position of the stream is the start of the values.

    Raises:
        One of ``BROKEN``: the header is invalid.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


_HDR_SIZE = re.compile(rb"[-+]Y (\d{1,9}) [-+]X (\d{1,9})\n")


def hdr_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in the header of a Radiance file. Return None if it is invalid."""
    # The size follows the first empty line.
    size = _HDR_SIZE.match(data, data.find(b"\n\n", 0, 4096) + 2)
    return None if size is None or not data.startswith(b"#?") else (int(size[2]), int(size[1]))


def exr_size(path: Path) -> tuple[int, int]:
    """Return the width and height of an OpenEXR file from its headers, without decoding pixels.

    If the file has several parts, return the size of the last part.

    Raises:
        ValueError: a part has more pixels than a picture may have.
        Exception: the file is damaged. The package raises several kinds of errors.
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


SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".webp", ".heic", ".heif")
_LOSSY = (".jpg", ".jpeg", ".webp", ".heic", ".heif")
# Bytes per pixel: four channels of 16 bits, and as much for the decoder.
_DECODED = 16


def decode_stored(path: Path, data: bytes) -> NDArray[Any]:
    """Decode a picture without conversion: [H, W] or [H, W, C] in OpenCV's order of channels, of any type.

    TIFF is decoded by tifffile, HEIC by pillow-heif, and other kinds by OpenCV after a check of their structure. Pillow
    would reduce 16-bit color to 8 bits.

    Raises:
        PolarguideError: the file is damaged, truncated, of an unsupported kind, or its samples are not gray or RGB.
    """
    damage = find_damage(data)
    size = None if damage is not None else declared_size(data)
    if size is not None and size[0] * size[1] > LARGEST_PIXELS:
        damage = f"one of {size[0]}x{size[1]} pixels, more than any camera has"
    if damage is not None:
        raise _unreadable(path, damage)
    kind = picture_kind(data)
    pixels = None
    try:
        if kind in TIFFS:
            pixels = decode_tiff(data)
        elif kind == "HEIF":
            pixels = heif_pixels(path, data)
        else:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except PolarguideError:
        raise
    except UnreadableTiffError as error:
        raise PolarguideError(
            path,
            expected="one ordinary gray or RGB picture in a TIFF file",
            found=str(error),
            remedy="Export one gray or RGB picture. If the file has four angles, save each in a file of its own, "
            f"such as {path.stem}_0.tif and {path.stem}_45.tif; or use the raw mosaic.",
        ) from None
    except Exception:  # decoders raise many kinds of errors
        pixels = None
    if pixels is None:
        _require_memory(path, size)
        raise _unreadable(path, "one that cannot be decoded")
    # The fourth byte of BMP is padding.
    return np.asarray(pixels[..., :3] if kind == "BMP" and pixels.ndim == 3 else pixels)


def _unreadable(path: Path, found: str) -> PolarguideError:
    """Return the error for an unsupported file. ``found`` is a noun phrase that describes it."""
    if "HEIC" in found or "AVIF" in found:
        return PolarguideError(
            path,
            expected="a PNG, JPEG, WebP, BMP, PGM or TIFF file, or an ordinary HEIC file",
            found=found,
            remedy="Export it as 16-bit TIFF or JPEG of the highest quality; phones can store JPEG or raw files.",
        )
    return damaged(path, "a complete PNG, JPEG or TIFF file (or WebP, BMP, PGM, HEIC)", found)


def is_lossy(path: Path) -> bool:
    """Return True if the suffix is that of JPEG, WebP or HEIC. These lossy formats are sRGB by convention."""
    return path.suffix.lower() in _LOSSY


def stated_full_scale(path: Path, file: BinaryIO, samples: NDArray[Any]) -> int | None:
    """Return the full scale that a picture file states. Return None if it is the largest value of the type.

    PGM and PPM state it in the header. For TIFF it follows from the number of bits or from MaxSampleValue, and for PNG
    from the number of significant bits (sBIT).

    Args:
        path: path of the file for messages.
        file: the open file, or its bytes.
        samples: stored values.

    Raises:
        PolarguideError: a sample exceeds the full scale.
    """
    head = file.read(HEAD)
    colors = samples[..., :3] if samples.ndim == 3 else samples
    if samples.dtype.kind != "u":
        return None
    kind = picture_kind(head)
    if kind == "PNG":
        return _full_of_significant(colors, significant_bits(head))
    full = pnm_full_scale(head)
    if full == np.iinfo(samples.dtype).max:
        full = None
    elif kind in TIFFS:
        file.seek(0)
        with tifffile.TiffFile(file) as tiff:
            full = tiff_full_scale(tiff)
    if full is not None and int(colors.max(initial=0)) > full:
        raise PolarguideError(
            path,
            expected=f"values up to {full}, the largest according to its header",
            found=f"{int(colors.max())}",
            remedy="Write the file with the maximum of the camera's values (1023 of 10 bits, 4095 of 12).",
        )
    return full


def _full_of_significant(samples: NDArray[Any], bits: int | None) -> int | None:
    """Return the full scale of a PNG file with significant bits.

    According to the standard, the significant bits are the high bits. Some programs of cameras store them as low bits
    instead. The function detects this case if all samples are small and their low bits are used.
    """
    kind = np.iinfo(samples.dtype)
    if bits is None or not 0 < bits < kind.bits:
        return None
    spare = kind.bits - bits
    at_bottom = int(samples.max(initial=0)) < 1 << bits and bool((samples & ((1 << spare) - 1)).any())
    return (1 << bits) - 1 if at_bottom else int(kind.max) >> spare << spare


def may_use_fewer_bits(path: Path) -> bool:
    """Return True for a 16-bit picture file that may have values of a sensor with fewer bits.

    Cameras with 10 to 14 bits write 16-bit PNG and TIFF files, which usually do not state the number of bits.
    """
    if not path.is_file():  # opening a pipe would block
        return False
    with contextlib.suppress(Exception), open(path, "rb") as file:  # tifffile raises several kinds of errors
        head = file.read(HEAD)
        if picture_kind(head) == "PNG":
            return head[24] == 16 and significant_bits(head) is None
        if picture_kind(head) in TIFFS:
            file.seek(0)
            with tifffile.TiffFile(file) as tiff:
                return tiff.pages.first.dtype == np.uint16 and tiff_full_scale(tiff) is None
    return False


def _require_memory(path: Path, size: tuple[int, int] | None) -> None:
    """Check that there is enough memory to decode a picture. Decoders report a lack of memory like damage.

    Raises:
        PolarguideError: there is too little memory for a picture of this size and its decoder.
    """
    width, height = size or (0, 0)
    try:
        np.empty(_DECODED * width * height, np.uint8)
    except MemoryError:
        raise PolarguideError(
            path,
            expected=f"memory for a picture of {width}x{height} pixels",
            found="less",
            remedy="Free memory, or check this shell's limits (ulimit -a).",
        ) from None


HEAD = 1 << 20
LARGEST_PIXEL = 32
"""Largest number of bytes per pixel in a file. Four channels of 64 bits take as many without compression."""
ROOM = 1 << 26
"""Largest size of a picture file's metadata in bytes, such as previews and profiles."""


def stated_size(path: Path) -> tuple[int, int] | None:
    """Return the width and height in the header of a picture or an array. Return None if they cannot be read.

    Supported are PNG, JPEG, WebP, HEIC, BMP, PGM, TIFF, Radiance HDR, OpenEXR and ``.npy``.
    """
    if not path.is_file():  # reported when the file is read
        return None
    with contextlib.suppress(*BROKEN), open(path, "rb") as file:
        suffix = path.suffix.lower()
        if suffix == ".exr":
            return exr_size(path)
        kind = picture_kind(file.read(16))
        file.seek(0)
        if kind in TIFFS:
            return tiff_size(file)
        head = file.read(LARGEST_FILE if kind in ("WebP", "HEIF") else HEAD)
        return {".hdr": hdr_size, ".npy": _array_size}.get(suffix, declared_size)(head)
    return None


def read_picture(path: Path) -> bytes:
    """Read the content of a picture file. A file that is far too large for its number of pixels is refused.

    Raises:
        PolarguideError: the file is too large or cannot be read.
    """
    size = stated_size(path)
    return read_file(
        path, largest=ROOM if size is None else min(LARGEST_FILE, ROOM + LARGEST_PIXEL * size[0] * size[1])
    )


def _array_size(head: bytes) -> tuple[int, int] | None:
    """Return the width and height of an array in an ``.npy`` file. The first axis of the array has the rows."""
    shape, _ = array_header(io.BytesIO(head))
    return (int(shape[1]), int(shape[0])) if len(shape) > 1 else None


def require_size(path: Path, data: bytes, size: Sequence[int], *, like: Path | None = None) -> None:
    """Refuse a picture of the wrong size by its header, before memory is allocated to decode it.

    Args:
        path: path of the file.
        data: content of the file.
        size: required height and width.
        like: another file with the required size, which the message names.

    Raises:
        PolarguideError: the header states another size.
    """
    stated = declared_size(data)
    if stated is not None and stated != (size[1], size[0]):
        alike = "the size of the pictures" if like is None else f"the size of {'/'.join(like.parts[-2:])}"
        raise PolarguideError(
            path,
            expected=f"{alike}, {size[1]}x{size[0]}",
            found=f"{stated[0]}x{stated[1]}",
            remedy="Create it again for these pictures."
            if like is None
            else "Export all pictures of a view with the same settings.",
        )


def require_alike(path: Path, picture: NDArray[Any], first_path: Path, first: NDArray[Any]) -> None:
    """Check that a picture has the same size and bit depth as the first picture of its view.

    Raises:
        PolarguideError: the size or the bit depth differs.
    """
    if (picture.shape, picture.dtype) != (first.shape, first.dtype):
        own, expected = (
            f"{p.shape[1]}x{p.shape[0]} with {p.dtype.itemsize * 8} bits" for p in (picture, first)
        )
        raise PolarguideError(
            path,
            expected=f"{expected} like {'/'.join(first_path.parts[-2:])}",
            found=own,
            remedy="Export all pictures of a view with the same settings.",
        )
