"""Write the pictures of a scene folder."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.files import make_folder, write_whole

_PNG = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_ALL_FILTERS),
    *(cv2.IMWRITE_PNG_COMPRESSION, 6),
)
"""The best filter of each row, by libpng's estimate: files of 0.5 to 0.85 of OpenCV's default."""


def rounding_of(step: float) -> int:
    """The power of two nearest to a quarter of what one step of the camera's values is in 16-bit codes, at least 1.

    Rounding to its multiples changes a value by less than a fifth of that step, the camera's own rounding by half of
    one. The files shrink, because their last bits then hold nothing.
    """
    return 1 << round(math.log2(step / 4)) if step >= 4 else 1


def intensity_codes(
    intensities: NDArray[np.float32], invalid: NDArray[np.bool_], rounding: int = 1
) -> NDArray[np.uint16]:
    """Linear intensities [4, H, W, 3] in [0, 1] as 16-bit codes, multiples of ``rounding`` but for the largest.

    Only invalid pixels [H, W] may have the largest code, because readers take it for saturation.
    """
    scaled = np.clip(intensities, 0.0, 1.0) * np.float32(FULL_CODE / rounding)
    codes = np.rint(scaled).astype(np.uint32) * rounding
    full = invalid[None, ..., None] & (codes >= FULL_CODE - rounding // 2)
    return np.where(full, FULL_CODE, np.minimum(codes, FULL_CODE - 1)).astype(np.uint16)


def picture_name(view: str, angle: int) -> str:
    """The path of a view's picture in its scene folder."""
    return f"polar/{view}_{angle:03d}.png"


def write_view(
    root: Path,
    view: str,
    codes: NDArray[np.uint16],
    invalid: NDArray[np.bool_] | None = None,
    mask: NDArray[np.bool_] | None = None,
) -> dict[str, int]:
    """Write the pictures of a view.

    Args:
        root: the scene folder.
        view: name of the view.
        codes: linear 16-bit codes at 0, 45, 90 and 135 degrees, [4, H, W, 3] RGB. Where the channels are equal, as
            those of a monochrome sensor are, one is written.
        invalid: unusable pixels, [H, W].
        mask: object mask, [H, W].

    Returns:
        The size in bytes of each file that was written, by its path in the scene folder.

    Raises:
        PolarguideError: a file cannot be written.
    """
    if (codes == codes[..., :1]).all():
        codes = codes[..., 0]
    files: dict[str, NDArray[Any]] = {
        picture_name(view, angle): picture for angle, picture in zip(ANGLES, codes, strict=True)
    }
    for folder, pixels in (("invalid", invalid), ("masks", mask)):
        if pixels is not None:
            files[f"{folder}/{view}.png"] = pixels.astype(np.uint8) * 255
    return {name: write_png(root / name, pixels) for name, pixels in files.items()}


def write_png(path: Path, pixels: NDArray[Any]) -> int:
    """Write a PNG file, and its folder if it is missing; returns the size in bytes.

    Args:
        path: the file.
        pixels: gray [H, W] or RGB [H, W, 3], uint8 or uint16.

    Raises:
        PolarguideError: the file cannot be written.
    """
    stored = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    done, data = cv2.imencode(".png", np.ascontiguousarray(stored), _PNG)
    if not done:
        raise OSError(f"{path}: the picture cannot be encoded")
    make_folder(path.parent)
    return write_whole(path, data.tobytes())
