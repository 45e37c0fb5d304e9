"""Decode TIFF files with tifffile, once their header says that the samples are those of one ordinary picture."""

from __future__ import annotations

import io
import itertools
import logging
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

# It logs what it finds odd in a file; what matters of it is an error here.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_GRAY, _RGB, _PALETTE, _YCBCR = 1, 2, 3, 6
_WHITE_IS_ZERO = 0
_SAMPLES = {_GRAY: 1, _RGB: 3, _PALETTE: 1, _YCBCR: 3}
_JPEG = (6, 7)
"""Compressions that decode to RGB what is stored as luminance and color differences."""
_NO_PICTURE, _OLD_REDUCED = 1 | 4, 2
"""Of NewSubfileType: a smaller copy, or a mask of transparency; of the older tag: a smaller copy."""
_MOST_PICTURES = 1000


class UnreadableTiffError(ValueError):
    """A TIFF file that is no ordinary picture; the text is a noun phrase that says why."""


def decode_tiff(data: bytes) -> tuple[NDArray[Any], int]:
    """The picture of a TIFF or BigTIFF file, neither turned nor scaled.

    Args:
        data: the whole file.

    Returns:
        [H, W] or [H, W, C] in OpenCV's order of channels (blue, green, red, alpha), of 8- or 16-bit whole numbers or
        floating-point numbers; and the bits of a sample, which may be fewer than those of the array.

    Raises:
        UnreadableTiffError: it has several pictures, or samples that mean something else.
        Exception: of a dozen kinds, where the file is damaged.
    """
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = _only_page(file)
        samples, transparent = _judged(page)
        pixels = np.asarray(page.asarray(maxworkers=1))
        size, bits = (page.imagelength, page.imagewidth), int(page.bitspersample)
        colors = page.colormap if page.photometric == _PALETTE else None
    if pixels.ndim == 3 and page.planarconfig == 2:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.shape != (size if samples == 1 else (*size, samples)):
        raise UnreadableTiffError("a TIFF file of several layers")
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if bits == 1 and pixels.dtype.kind in "bu":
        pixels, bits = pixels.astype(np.uint8) * np.uint8(255), 8
    if colors is not None:
        # Palettes have 16 bits; those of 8-bit colors are multiples of 257.
        pixels, bits = np.rint(np.asarray(colors).T[pixels] / 257).astype(np.uint8), 8
    if transparent and samples == 2:
        return pixels[..., [0, 0, 0, 1]], bits
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3]] if transparent else pixels[..., ::-1]
    return pixels, bits


def _only_page(file: tifffile.TiffFile) -> tifffile.TiffPage:
    """The page of the picture.

    Raises:
        UnreadableTiffError: there are several, or it begins with another one.
    """
    pages = [page.aspage() for page in itertools.islice(file.pages, _MOST_PICTURES)]
    whole = [page for page in pages if not _is_copy(page)]
    stacked = int((file.imagej_metadata or {}).get("images", 1))
    if len(whole) > 1 or stacked > 1:
        raise UnreadableTiffError(f"a TIFF file of {max(len(whole), stacked)} pictures")
    if not whole or whole[0] is not pages[0]:
        raise UnreadableTiffError("a TIFF file that begins with a smaller copy of its picture")
    return whole[0]


def _is_copy(page: tifffile.TiffPage) -> bool:
    """Whether a page is a smaller copy or a mask of another one."""
    older = page.tags.get(255)
    return bool(page.subfiletype & _NO_PICTURE) or (older is not None and older.value == _OLD_REDUCED)


def _judged(page: tifffile.TiffPage) -> tuple[int, bool]:
    """Samples of a pixel, and whether the last is transparency.

    Raises:
        UnreadableTiffError: the samples are not those of a gray or a color picture.
    """
    meaning, samples = int(page.photometric), int(page.samplesperpixel)
    if meaning == _WHITE_IS_ZERO:
        raise UnreadableTiffError("a TIFF file whose white is 0")
    if meaning not in _SAMPLES or (meaning == _YCBCR and int(page.compression) not in _JPEG):
        name = getattr(page.photometric, "name", str(meaning)).lower()
        raise UnreadableTiffError(f"a TIFF file of the color model {name}")
    more = samples - _SAMPLES[meaning]
    extra = tuple(int(kind) for kind in page.extrasamples)
    # Many writers leave the fourth sample of RGB unnamed; a second one of gray may be anything.
    alpha = more == 1 and meaning in (_GRAY, _RGB) and (meaning == _RGB or extra[:1] in {(1,), (2,)})
    if more and not alpha:
        what = "gray" if meaning == _GRAY else "color"
        raise UnreadableTiffError(f"a TIFF file of {samples} samples a pixel, more than {what} has")
    whole = page.dtype is not None and page.dtype.kind in "bu" and page.dtype.itemsize <= 2
    if page.dtype is None or not (whole or page.dtype.kind == "f"):
        raise UnreadableTiffError(f"a TIFF file with values of type {page.dtype}")
    return samples, alpha
