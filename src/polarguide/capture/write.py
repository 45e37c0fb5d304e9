"""Pictures of a scene folder: linear intensities to 16-bit codes, and codes to PNG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.view import FULL_CODE


def picture_codes(intensities: NDArray[np.float32], invalid: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Linear intensities -> 16-bit codes; full scale is left to invalid pixels, for it means saturated."""
    codes = np.rint(np.clip(intensities, 0.0, 1.0) * FULL_CODE).astype(np.uint16)
    return np.where(invalid[None, ..., None], codes, np.minimum(codes, FULL_CODE - 1)).astype(np.uint16)


def encoded_png(pixels: NDArray[Any]) -> bytes:
    """A PNG file."""
    done, data = cv2.imencode(".png", pixels)
    if not done:
        raise OSError("the picture cannot be encoded")
    return data.tobytes()
