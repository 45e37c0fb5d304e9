"""The encoding that the color profile of a picture file states."""

from __future__ import annotations

import math
import struct
import zlib

from polarguide.capture.formats.integrity import TIFF, jpeg_segments, png_chunks, tiff_entries, tiff_order
from polarguide.capture.formats.plain import is_webp, webp_chunks

_TIFF_PROFILE = 34675
_JPEG_PROFILE = b"ICC_PROFILE\0"
_CURVES = (b"rTRC", b"kTRC")
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}
_MIDDLE = 0.5


def stated_exponent(data: bytes) -> float | None:
    """The exponent e that the ICC profile of a PNG, JPEG, WebP or TIFF file states: light = value ^ e at half scale.

    1 is linear, 2.2 sRGB and Adobe RGB, 1.8 ProPhoto RGB. None where there is no profile, or none of this kind.
    """
    try:
        profile = _profile(data)
        decoded = None if profile is None else _decoded_middle(profile)
    except (struct.error, zlib.error, OverflowError, ValueError, IndexError):
        return None  # a damaged profile states nothing
    if decoded is None or not 0 < decoded < 1:
        return None
    return math.log(decoded) / math.log(_MIDDLE)


def _profile(data: bytes) -> bytes | None:
    """The ICC profile in a picture file."""
    if data.startswith(b"\xff\xd8"):
        parts = [content for kind, content in jpeg_segments(data) if kind == 0xE2]
        parts = [part[len(_JPEG_PROFILE) + 2 :] for part in parts if part.startswith(_JPEG_PROFILE)]
        return b"".join(parts) or None
    if data.startswith(b"\x89PNG"):
        chunk = next((data[at + 8 : end - 4] for kind, at, end in png_chunks(data) if kind == b"iCCP"), None)
        return None if chunk is None else zlib.decompress(chunk[chunk.index(b"\0") + 2 :])
    if is_webp(data):
        return next((data[at:end] for kind, at, end in webp_chunks(data) if kind == b"ICCP"), None)
    if data[:4] in TIFF:
        for tag, _, count, place in tiff_entries(data):
            if tag == _TIFF_PROFILE:
                (at,) = struct.unpack_from(tiff_order(data) + "I", data, place)
                return data[at : at + count]
    return None


def _decoded_middle(profile: bytes) -> float | None:
    """What the red or gray curve of a profile makes of half scale (ICC.1, curveType and parametricCurveType)."""
    (count,) = struct.unpack_from(">I", profile, 128)
    entries = [struct.unpack_from(">4sII", profile, 132 + 12 * number) for number in range(min(count, 100))]
    at = next((at for name, at, _ in entries if name in _CURVES), None)
    if at is None:
        return None
    kind = profile[at : at + 4]
    if kind == b"curv":
        (count,) = struct.unpack_from(">I", profile, at + 8)
        if count == 0:
            return _MIDDLE
        if count == 1:
            return float(_MIDDLE ** (struct.unpack_from(">H", profile, at + 12)[0] / 256))
        return float(struct.unpack_from(">H", profile, at + 12 + 2 * round(_MIDDLE * (count - 1)))[0]) / 65535
    if kind != b"para":
        return None
    (form,) = struct.unpack_from(">H", profile, at + 8)
    if form not in _PARAMETERS:
        return None
    numbers = [n / 65536 for n in struct.unpack_from(f">{_PARAMETERS[form]}i", profile, at + 12)]
    factor, shift = numbers[1:3] if form else (1.0, 0.0)
    # Half scale lies above the linear part of every curve in use.
    raised = numbers[{2: 3, 4: 5}[form]] if form in (2, 4) else 0.0
    return float(max(0.0, factor * _MIDDLE + shift) ** max(numbers[0], 0.1) + raised)
