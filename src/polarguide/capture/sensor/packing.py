"""Unpack packed pixels: 10p and 12p of GenICam's Pixel Format Naming Convention, 12Packed of GigE Vision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PACKINGS = {"10p": (5, 4, 10), "12p": (3, 2, 12), "12packed": (3, 2, 12)}
"""Bytes of a group, pixels of a group, bits of a pixel."""


def packed_size(width: int, height: int, packing: str) -> int:
    """Bytes of a packed picture: rows follow one another without padding, the last group is filled up."""
    group, pixels, _ = PACKINGS[packing]
    return -(-width * height // pixels) * group


def unpack(data: bytes, width: int, height: int, packing: str) -> NDArray[np.uint16]:
    """Unpack a picture.

    ``10p`` and ``12p`` are little-endian bit streams, low bits first: bit b of pixel k is bit ``bits * k + b``
    of the file (GenICam PFNC). In ``12packed`` (GigE Vision) bytes 0 and 2 are the high eight bits of two
    pixels, the low nibble of byte 1 the low four bits of the first, its high nibble those of the second.

    Args:
        data: exactly ``packed_size`` bytes.
        width, height: size of the picture.
        packing: a key of ``PACKINGS``.

    Returns:
        [height, width] values from 0 to 2^bits - 1.
    """
    group, pixels, _ = PACKINGS[packing]
    parts = np.frombuffer(data, np.uint8).reshape(-1, group).astype(np.uint16)
    values = np.empty((len(parts), pixels), np.uint16)
    if packing == "12p":
        values[:, 0] = parts[:, 0] | (parts[:, 1] & 0x0F) << 8
        values[:, 1] = parts[:, 1] >> 4 | parts[:, 2] << 4
    elif packing == "12packed":
        values[:, 0] = parts[:, 0] << 4 | parts[:, 1] & 0x0F
        values[:, 1] = parts[:, 2] << 4 | parts[:, 1] >> 4
    else:
        for pixel in range(pixels):
            # Pixel k starts 2k bits into byte k and reaches into the next one.
            low, high = parts[:, pixel] >> 2 * pixel, parts[:, pixel + 1] << 8 - 2 * pixel
            values[:, pixel] = (low | high) & 0x3FF
    return values.reshape(-1)[: width * height].reshape(height, width)
