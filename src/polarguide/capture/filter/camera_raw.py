"""Develop camera raw files to linear pictures, with the same processing for every shot.

LibRaw (package rawpy) runs without any step that depends on the picture: no automatic brightness, white level or white
balance, no gamma, no color matrix. The remaining steps are the same for every shot: black level, fixed gains, a linear
scale and demosaicing.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.arrays import array_kind
from polarguide.capture.formats.integrity import LARGEST_PIXELS
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import read_file

CAMERA_RAW = (".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
"""Suffixes that are read as camera raw."""
_FULL = 65535
_EXIF_OF_FLIP = {0: 1, 3: 3, 5: 8, 6: 6}


def is_camera_raw(path: Path) -> bool:
    """Whether a file is a camera raw file, by its suffix."""
    return path.suffix.lower() in CAMERA_RAW


def read_camera_raw(
    path: Path, gains: tuple[float, float, float], *, opener: Callable[[io.BytesIO], Any] | None = None
) -> tuple[NDArray[np.uint16], int]:
    """Develop a camera raw file.

    Args:
        path: the file.
        gains: of R, G and B; the smallest becomes 1, so that full scale of the sensor is full scale of the picture.
        opener: takes the file's bytes and returns what ``rawpy.imread`` would; rawpy itself if None.

    Returns:
        [H, W, 3] linear RGB in the camera's own colors, not turned; and the EXIF orientation, 1 to 8.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read or is damaged.
    """
    opened = opener or optional_import("rawpy", str(path)).imread
    data = read_file(path)
    try:
        with opened(io.BytesIO(data)) as raw:
            if raw.sizes.raw_width * raw.sizes.raw_height > LARGEST_PIXELS:
                raise ValueError(f"{raw.sizes.raw_width}x{raw.sizes.raw_height} pixels")
            flip = int(raw.sizes.flip)  # before user_flip takes its place
            pixels = np.asarray(raw.postprocess(**libraw_parameters(gains)))
            reached = _reached(raw)
    except Exception as error:  # LibRaw's errors have a class each; damaged files raise others, too
        said = _words(error)
        raise PolarguideError(
            path,
            expected="a complete camera raw file",
            found="an empty file" if not data else f"one that cannot be developed ({said})",
            remedy="Copy the file again, or develop it to 16-bit linear TIFF.",
        ) from error
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint16:
        raise PolarguideError(
            path,
            expected="a camera raw file with three colors",
            found=array_kind(pixels),
            remedy="Develop it to 16-bit linear TIFF.",
        )
    return _to_full_scale(pixels, reached), _EXIF_OF_FLIP.get(flip, 1)


def _reached(raw: Any) -> float:
    """The code at which LibRaw puts the white level.

    Of files that are no mosaics (linear DNG, such as a telephone's ProRAW) it subtracts the black levels of three
    channels from the samples, and that of a fourth one, which is 0, from the white level.
    """
    if raw.raw_type.name != "Stack":
        return _FULL
    black, white = raw.black_level_per_channel, raw.white_level
    return float((white - max(black[:3])) / (white - min(black)) * _FULL)


def _to_full_scale(pixels: NDArray[np.uint16], reached: float) -> NDArray[np.uint16]:
    """Pixels whose white level is at 65535: what clipped in the camera has to be known. LibRaw rounds down."""
    if reached < _FULL:
        pixels = np.minimum(np.rint(pixels * np.float32(_FULL / reached)), _FULL).astype(np.uint16)
    return np.where(pixels >= _FULL - 1, np.uint16(_FULL), pixels)


def stored_frame(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height of the pixels of a camera raw file as stored, and its EXIF orientation; nothing is developed.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read.
    """
    libraw = optional_import("rawpy", str(path))
    data = read_file(path)
    try:
        with libraw.imread(io.BytesIO(data)) as raw:
            return (int(raw.sizes.width), int(raw.sizes.height)), _EXIF_OF_FLIP.get(int(raw.sizes.flip), 1)
    except Exception as error:  # LibRaw's errors have a class each; damaged files raise others, too
        raise PolarguideError(
            path,
            expected="a complete camera raw file",
            found=f"one that cannot be opened ({_words(error)})",
            remedy="Copy the file again, or develop it to 16-bit linear TIFF.",
        ) from error


def _words(error: Exception) -> str:
    """LibRaw's error message, which may be bytes, as one line."""
    said = error.args[0] if error.args else ""
    text = said.decode(errors="replace") if isinstance(said, bytes) else str(said)
    return (text.strip().splitlines() or [type(error).__name__])[0]


def libraw_parameters(gains: tuple[float, float, float]) -> dict[str, Any]:
    """LibRaw's settings, by the names of ``rawpy.Params``."""
    red, green, blue = (gain / min(gains) for gain in gains)
    settings: dict[str, Any] = {
        "gamma": (1.0, 1.0),
        "output_bps": 16,
        "no_auto_bright": True,
        "bright": 1.0,
        # Otherwise the white level follows the brightest pixel of each shot.
        "adjust_maximum_thr": 0.0,
        "use_camera_wb": False,
        "use_auto_wb": False,
        "user_wb": [red, green, blue, green],
        "user_flip": 0,
        "median_filter_passes": 0,
    }
    with contextlib.suppress(ImportError):
        rawpy = importlib.import_module("rawpy")
        settings |= {
            "output_color": rawpy.ColorSpace.raw,
            "demosaic_algorithm": rawpy.DemosaicAlgorithm.LINEAR,
            "highlight_mode": rawpy.HighlightMode.Clip,
            "fbdd_noise_reduction": rawpy.FBDDNoiseReductionMode.Off,
        }
    return settings
