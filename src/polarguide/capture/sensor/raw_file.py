"""Read raw mosaics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.arrays import array_kind, read_array
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import decode_stored, read_file
from polarguide.capture.sensor.packing import PACKINGS, packed_size, unpack
from polarguide.errors import PolarguideError

RAW_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".raw")


@dataclass(frozen=True)
class RawFormat:
    """Size and packing of a packed file, which does not contain them. Other files do not need them."""

    width: int | None = None
    height: int | None = None
    packing: str | None = None

    def container(self, path: Path, kind: np.dtype[Any]) -> int:
        """Bits that a pixel of type ``kind`` takes in a file."""
        packing = self.packing if path.suffix.lower() == ".raw" else None
        return kind.itemsize * 8 if packing is None else PACKINGS[packing][2]


def read_mosaic(path: Path, raw: RawFormat, *, least: int = 1) -> NDArray[Any]:
    """Read one raw mosaic.

    Args:
        path: a PNG, TIFF, ``.npy`` or packed ``.raw`` file.
        raw: size and packing of a ``.raw`` file; where it gives a size, other files must have it too.
        least: pixels that the shorter side must have.

    Returns:
        [H, W] uint8 or uint16, the values as stored.

    Raises:
        PolarguideError: the file cannot be read, is damaged, has color channels or another size, or is too small.
    """
    packed = path.suffix.lower() == ".raw"
    values = _read_packed(path, read_file(path), raw) if packed else _read_plain(path, raw)
    if min(values.shape) < least:
        raise PolarguideError(
            path,
            expected=f"a mosaic of at least {least}x{least} pixels",
            found=f"{values.shape[1]}x{values.shape[0]}",
            remedy="Give the whole picture of the sensor.",
        )
    return values


def _read_plain(path: Path, raw: RawFormat) -> NDArray[Any]:
    suffix = path.suffix.lower()
    values = read_array(path) if suffix == ".npy" else decode_stored(path, read_picture(path))
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype not in (np.uint8, np.uint16) or 0 in values.shape:
        raise PolarguideError(
            path,
            expected="a raw mosaic: one channel of 8- or 16-bit whole numbers",
            found=array_kind(values),
            remedy="Save what the sensor delivers, before any demosaicing or conversion to color.",
        )
    found = (values.shape[1], values.shape[0])
    wanted = (raw.width or found[0], raw.height or found[1])
    if found != wanted:
        raise PolarguideError(
            path,
            expected=f"{wanted[0]}x{wanted[1]} pixels, as --width and --height say",
            found=f"{found[0]}x{found[1]}",
            remedy="Leave the two flags out for files that know their size.",
        )
    return values


def _read_packed(path: Path, data: bytes, raw: RawFormat) -> NDArray[np.uint16]:
    if raw.width is None or raw.height is None or raw.packing is None:
        flags = {"--width": raw.width, "--height": raw.height, "--packing": raw.packing}
        raise PolarguideError(
            path,
            expected="width, height and packing of a .raw file",
            found=f"no {', '.join(flag for flag, value in flags.items() if value is None)}",
            remedy=f"Give them as the camera was set; packings are {', '.join(PACKINGS)} and are never guessed.",
        )
    size = packed_size(raw.width, raw.height, raw.packing)
    if len(data) != size:
        raise PolarguideError(
            path,
            expected=f"{size} bytes for {raw.width}x{raw.height} pixels in {raw.packing}",
            found=f"{len(data)}",
            remedy="Check --width, --height and --packing; a file that is too short may be cut off.",
        )
    return unpack(data, raw.width, raw.height, raw.packing)
