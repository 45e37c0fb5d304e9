"""Write the pictures of a scene folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.exposures import Angle, angle_labels
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.core.files import make_folder, write_whole

# Of PNG: the second is better for few values, as those of JPEGs that nothing resampled. libpng's own choice for each
# row makes files no smaller, as low bits that hold nothing mislead its estimate, and slower to read.
_FILTERS = (cv2.IMWRITE_PNG_FILTER_SUB, cv2.IMWRITE_PNG_FILTER_NONE)
_TRIED_ROWS = 64
_LEVEL = 6
Rounding = Sequence[tuple[int, int]]
"""Codes from the first number of a pair on, up to the next pair's, are multiples of its second number."""
EXACT: Rounding = ((0, 1),)


def rounding_of(values: NDArray[np.floating[Any]]) -> list[tuple[int, int]]:
    """Rounding of codes: the power of two nearest to a quarter of the camera's step there, at least 1.

    Rounding changes a value by less than a fifth of the step, the camera's own rounding by half of it. Files shrink,
    because their last bits then hold nothing.

    Args:
        values: [N] the values that the camera has around there, ascending, as 16-bit codes; at least two.
    """
    # Where steps grow with the values, as those of sRGB do, none is taken for larger than those above it.
    steps = np.minimum.accumulate(np.diff(values)[::-1])[::-1]
    multiples = np.exp2(np.round(np.log2(np.maximum(steps / 4, 1)))).astype(int)
    changes = np.flatnonzero(np.diff(multiples, prepend=0))
    starts = np.ceil(values[changes]).astype(int)
    starts[0] = 0
    return list(zip(starts.tolist(), multiples[changes].tolist(), strict=True))


def intensity_codes(
    intensities: NDArray[np.float32], invalid: NDArray[np.bool_], rounding: Rounding = EXACT
) -> NDArray[np.uint16]:
    """Linear intensities [K, H, W, 3] in [0, 1] as 16-bit codes, rounded, but for the largest.

    Only invalid pixels [H, W] may have the largest code, because readers take it for saturation.
    """
    values = np.clip(intensities, 0.0, 1.0) * np.float32(FULL_CODE)
    multiples: Any = np.float32(rounding[0][1])
    if len(rounding) > 1:
        starts, rounded = (np.array(numbers) for numbers in zip(*rounding, strict=True))
        table = rounded[np.searchsorted(starts, np.arange(FULL_CODE + 1), side="right") - 1]
        multiples = table.astype(np.float32)[values.astype(np.uint16)]
    codes = (np.rint(values / multiples) * multiples).astype(np.uint32)
    full = invalid[None, ..., None] & (codes >= FULL_CODE - multiples // 2)
    return np.where(full, FULL_CODE, np.minimum(codes, FULL_CODE - 1)).astype(np.uint16)


def picture_name(view: str, angle: int) -> str:
    """The path of a view's picture in its scene folder."""
    return f"polar/{view}_{angle:03d}.png"


def picture_names(view: str, angles: Sequence[Angle] = ANGLES) -> list[str]:
    """The paths of a view's pictures at any angles in its scene folder."""
    return [f"polar/{view}_{label}.png" for label in angle_labels(angles)]


def write_view(
    root: Path,
    view: str,
    codes: NDArray[np.uint16],
    invalid: NDArray[np.bool_] | None = None,
    mask: NDArray[np.bool_] | None = None,
    angles: Sequence[Angle] = ANGLES,
) -> dict[str, int]:
    """Write the pictures of a view.

    Args:
        root: the scene folder.
        view: name of the view.
        codes: linear 16-bit codes at ``angles``, [K, H, W, 3] RGB. Where the channels are equal, as
            those of a monochrome sensor are, one is written.
        invalid: unusable pixels, [H, W].
        mask: object mask, [H, W].
        angles: angles of the pictures, where there are others than four.

    Returns:
        The size in bytes of each file that was written, by its path in the scene folder.

    Raises:
        PolarguideError: a file cannot be written.
    """
    if (codes == codes[..., :1]).all():
        codes = codes[..., 0]
    files: dict[str, NDArray[Any]] = dict(zip(picture_names(view, angles), codes, strict=True))
    for folder, pixels in (("invalid", invalid), ("masks", mask)):
        if pixels is not None:
            files[f"{folder}/{view}.png"] = pixels.astype(np.uint8) * 255
    with ThreadPoolExecutor(min(len(files), os.cpu_count() or 1)) as pool:  # compression takes longest
        encoded = list(pool.map(_png_data, (root / name for name in files), files.values()))
    return {name: _write(root / name, data) for name, data in zip(files, encoded, strict=True)}


def write_png(path: Path, pixels: NDArray[Any]) -> int:
    """Write a PNG file, and its folder if it is missing; returns the size in bytes.

    Args:
        path: the file.
        pixels: gray [H, W] or RGB [H, W, 3], uint8 or uint16.

    Raises:
        PolarguideError: the file cannot be written.
    """
    return _write(path, _png_data(path, pixels))


def _png_data(path: Path, pixels: NDArray[Any]) -> bytes:
    stored = np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    first = max(0, (len(stored) - _TRIED_ROWS) // 2)
    tried = stored[first : first + _TRIED_ROWS]
    return _encoded(path, stored, min(_FILTERS, key=lambda way: len(_encoded(path, tried, way))))


def _encoded(path: Path, stored: NDArray[Any], way: int) -> bytes:
    options = (cv2.IMWRITE_PNG_FILTER, way, cv2.IMWRITE_PNG_COMPRESSION, _LEVEL)
    done, data = cv2.imencode(".png", stored, options)
    if not done:
        raise OSError(f"{path}: the picture cannot be encoded")
    return data.tobytes()


def _write(path: Path, data: bytes) -> int:
    make_folder(path.parent)
    return write_whole(path, data)
