"""Write the pictures of a scene folder."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from polarguide.capture.exposures import Angle, angle_labels
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.core.files import make_folder, write_whole

# Filters of PNG. The second is better for few values, such as those of JPEG files without resampling. libpng's adaptive
# choice makes files no smaller, because unused low bits mislead its estimate, and slower to read.
_FILTERS = (cv2.IMWRITE_PNG_FILTER_SUB, cv2.IMWRITE_PNG_FILTER_NONE)
_SAMPLE_ROWS = 64
_LEVEL = 6
Rounding = Sequence[tuple[int, int]]
"""Rounding of codes. A pair has the first code of a range, and the step to whose multiples its codes are rounded."""
EXACT: Rounding = ((0, 1),)


def rounding_of(values: NDArray[np.floating[Any]]) -> list[tuple[int, int]]:
    """Choose steps to which codes are rounded, so that files become smaller.

    A step is the power of two nearest to a quarter of the difference of two successive values of the camera, and at
    least 1. Rounding to it causes an error of less than a fifth of the camera's own step.

    Args:
        values: the camera's values as 16-bit codes, ascending, [N] with N > 1.
    """
    # Steps may grow with the values, as in sRGB. No step is larger than the steps of larger values.
    steps = np.minimum.accumulate(np.diff(values)[::-1])[::-1]
    multiples = np.exp2(np.round(np.log2(np.maximum(steps / 4, 1)))).astype(int)
    changes = np.flatnonzero(np.diff(multiples, prepend=0))
    starts = np.ceil(values[changes]).astype(int)
    starts[0] = 0
    return list(zip(starts.tolist(), multiples[changes].tolist(), strict=True))


RADIANCE_SUFFIX = ".tif"
"""Suffix of pictures that hold linear radiance as floating-point numbers."""
_SIGNIFICANT_BITS = 14
"""Number of significant bits of stored radiance. The error is less than a fifth of a step of a 12-bit sensor."""


def rounded_radiance(intensities: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round radiance to 14 significant bits, so that files become smaller."""
    mantissa, exponent = np.frexp(intensities)
    scale = np.float32(1 << _SIGNIFICANT_BITS)
    return np.asarray(np.ldexp(np.rint(mantissa * scale) / scale, exponent), np.float32)


def intensity_codes(
    intensities: NDArray[np.float32], invalid: NDArray[np.bool_], rounding: Rounding = EXACT
) -> NDArray[np.uint16]:
    """Convert linear intensities [K, H, W, 3] in [0, 1] to rounded 16-bit codes.

    Readers interpret the largest code as saturation. Pixels outside the mask ``invalid`` [H, W] therefore get smaller
    codes.
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
    """Return the path of a view's picture in its scene folder."""
    return f"polar/{view}_{angle:03d}.png"


def picture_names(view: str, angles: Sequence[Angle] = ANGLES, suffix: str = ".png") -> list[str]:
    """Return the paths of a view's pictures in its scene folder."""
    return [f"polar/{view}_{label}{suffix}" for label in angle_labels(angles)]


def suffix_of(files: Iterable[str]) -> str:
    """Return the suffix of the pictures among the files of a view in a scene folder."""
    radiance = any(name.endswith(RADIANCE_SUFFIX) for name in files)
    return RADIANCE_SUFFIX if radiance else ".png"


def write_view(
    root: Path,
    view: str,
    codes: NDArray[np.uint16] | NDArray[np.float32],
    invalid: NDArray[np.bool_] | None = None,
    mask: NDArray[np.bool_] | None = None,
    angles: Sequence[Angle] = ANGLES,
) -> dict[str, int]:
    """Write the pictures and masks of a view to a scene folder.

    Args:
        root: scene folder.
        view: name of the view.
        codes: linear 16-bit codes of the pictures, [K, H, W, 3] RGB. Floating-point numbers are linear radiance, which
            is written to TIFF files. If all three channels are equal, one channel is written.
        invalid: mask of unusable pixels, [H, W].
        mask: foreground mask, [H, W].
        angles: angles of the pictures.

    Returns:
        Size of each file in bytes by its path in the scene folder.

    Raises:
        PolarguideError: a file cannot be written.
    """
    if (codes == codes[..., :1]).all():
        codes = codes[..., 0]
    suffix = ".png" if codes.dtype == np.uint16 else RADIANCE_SUFFIX
    files: dict[str, NDArray[Any]] = dict(zip(picture_names(view, angles, suffix), codes, strict=True))
    for folder, pixels in (("invalid", invalid), ("masks", mask)):
        if pixels is not None:
            files[f"{folder}/{view}.png"] = pixels.astype(np.uint8) * 255
    with ThreadPoolExecutor(
        min(len(files), os.cpu_count() or 1)
    ) as pool:  # compression takes most of the time
        encoded = list(pool.map(_picture_data, (root / name for name in files), files.values()))
    return {name: _write(root / name, data) for name, data in zip(files, encoded, strict=True)}


def write_png_file(path: Path, pixels: NDArray[Any]) -> int:
    """Write a PNG file, create its folder if necessary, and return the size in bytes.

    Args:
        path: path of the file.
        pixels: gray [H, W] or RGB [H, W, 3], uint8 or uint16.

    Raises:
        PolarguideError: the file cannot be written.
    """
    return _write(path, _png_data(path, pixels))


def _picture_data(path: Path, pixels: NDArray[Any]) -> bytes:
    """Encode floating-point pixels as TIFF, and whole numbers as PNG."""
    if pixels.dtype.kind != "f":
        return _png_data(path, pixels)
    data = io.BytesIO()
    photometric = "rgb" if pixels.ndim == 3 else "minisblack"
    tifffile.imwrite(data, pixels, photometric=photometric, compression="zlib", predictor=True, metadata=None)
    return data.getvalue()


def _png_data(path: Path, pixels: NDArray[Any]) -> bytes:
    stored = np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    first = max(0, (len(stored) - _SAMPLE_ROWS) // 2)
    sample = stored[first : first + _SAMPLE_ROWS]
    return _encoded(
        path, stored, min(_FILTERS, key=lambda png_filter: len(_encoded(path, sample, png_filter)))
    )


def _encoded(path: Path, stored: NDArray[Any], png_filter: int) -> bytes:
    success, data = cv2.imencode(
        ".png", stored, (cv2.IMWRITE_PNG_FILTER, png_filter, cv2.IMWRITE_PNG_COMPRESSION, _LEVEL)
    )
    if not success:
        raise OSError(f"{path}: the picture cannot be encoded")
    return data.tobytes()


def _write(path: Path, data: bytes) -> int:
    make_folder(path.parent)
    return write_whole(path, data)
