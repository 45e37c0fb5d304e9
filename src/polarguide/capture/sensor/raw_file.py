"""Read raw mosaics from pictures, arrays, and files with packed pixels of industrial cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.pictures import (
    array_kind,
    decode_stored,
    read_array,
    read_picture,
    stated_full_scale,
)
from polarguide.capture.sensor.pattern import Packing
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import read_file

PACKINGS: dict[Packing, tuple[int, int, int]] = {
    "8": (1, 1, 8), "16": (2, 1, 16), "16be": (2, 1, 16),
    "10p": (5, 4, 10), "10packed": (3, 2, 10), "10mipi": (5, 4, 10),
    "12p": (3, 2, 12), "12packed": (3, 2, 12), "12mipi": (3, 2, 12),
}  # fmt: skip
"""Number of bytes per group, of pixels per group and of bits per pixel for each packing."""


def packed_size(width: int, height: int, packing: Packing) -> int:
    """Return the number of bytes of a packed picture. Rows have no padding, but the last group of pixels may have."""
    group, pixels, _ = PACKINGS[packing]
    return -(-width * height // pixels) * group


def unpack(data: bytes, width: int, height: int, packing: Packing) -> NDArray[Any]:
    """Convert the bytes of a packed picture to pixel values.

    - ``8``, ``16`` and ``16be``: a pixel takes one or two bytes. ``16`` has the low byte first, ``16be`` the high byte.
    - ``10p`` and ``12p`` (GenICam PFNC): the file is a bit stream with low bits first. Bit b of pixel k is bit
      ``bits * k + b`` of the file.
    - ``10packed`` and ``12packed`` (GigE Vision): two pixels take three bytes. Bytes 0 and 2 have the high eight bits
      of the two pixels. The low bits of the first pixel start at bit 0 of byte 1, and those of the second at bit 4.
    - ``10mipi`` and ``12mipi`` (MIPI CSI-2): each pixel of a group has a byte with its high eight bits. The last byte
      of the group has the low bits of all of its pixels, one after the other.

    Args:
        data: exactly ``packed_size`` bytes.
        width, height: size of the picture.
        packing: a key of ``PACKINGS``.

    Returns:
        Values [height, width] from 0 to 2^bits - 1. The type is uint8 for the packing ``8``, otherwise uint16.
    """
    group, pixels, bits = PACKINGS[packing]
    if pixels == 1:
        kind = np.dtype({"8": "u1", "16": "<u2"}.get(packing, ">u2"))
        return np.frombuffer(data, kind).astype(kind.newbyteorder("=")).reshape(height, width)
    parts = np.frombuffer(data, np.uint8).reshape(-1, group).astype(np.uint16)
    values = np.empty((len(parts), pixels), np.uint16)
    low = bits - 8
    for pixel in range(pixels):
        if packing.endswith("p"):
            # Pixel k starts ``bits * k`` bits into the group, and reaches into the next byte.
            byte, shift = divmod(bits * pixel, 8)
            values[:, pixel] = (parts[:, byte] >> shift | parts[:, byte + 1] << 8 - shift) & (1 << bits) - 1
        elif packing.endswith("packed"):
            values[:, pixel] = parts[:, 2 * pixel] << low | parts[:, 1] >> 4 * pixel & (1 << low) - 1
        else:
            values[:, pixel] = parts[:, pixel] << low | parts[:, -1] >> low * pixel & (1 << low) - 1
    return values.reshape(-1)[: width * height].reshape(height, width)


RAW_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy", ".raw")


@dataclass(frozen=True)
class RawFormat:
    """Picture size and packing that the user specifies for ``.raw`` files, which have no header."""

    width: int | None = None
    height: int | None = None
    packing: Packing | None = None

    def container(self, path: Path, kind: np.dtype[Any]) -> int:
        """Return the number of bits that a pixel takes in a file. ``kind`` is the type of its values after reading."""
        packing = self.packing if path.suffix.lower() == ".raw" else None
        return kind.itemsize * 8 if packing is None else PACKINGS[packing][2]

    def full_scale(self, path: Path, values: NDArray[Any]) -> int | None:
        """Return the full scale that a file states for its values [H, W], see ``stated_full_scale``."""
        if path.suffix.lower() in (".raw", ".npy"):
            return None
        with open(path, "rb") as file:
            return stated_full_scale(path, file, values)


def read_mosaic(path: Path, raw: RawFormat, *, least: int = 1) -> NDArray[Any]:
    """Read one raw mosaic.

    Args:
        path: a PNG, TIFF, ``.npy`` or packed ``.raw`` file.
        raw: size and packing of a ``.raw`` file. If a size is specified, other files must have it, too.
        least: smallest length of the shorter side in pixels that is accepted.

    Returns:
        Stored values [H, W], uint8 or uint16.

    Raises:
        PolarguideError: the file cannot be read, is damaged, has color channels or another size, is too small, or has
            four pictures.
    """
    packed = path.suffix.lower() == ".raw"
    values = _read_packed(path, read_file(path), raw) if packed else _read_plain(path, raw)
    require_mosaic(path, values, least=least)
    return values


def require_mosaic(where: Path | str, values: NDArray[Any], *, least: int) -> None:
    """Refuse values [H, W] that are not a raw mosaic. ``least`` is the smallest length of the shorter side.

    Raises:
        PolarguideError: the picture is too small, or shows four small pictures in a grid.
    """
    require(
        min(values.shape) >= least,
        where,
        expected=f"a mosaic of at least {least}x{least} pixels",
        found=f"{values.shape[1]}x{values.shape[0]}",
        remedy="Use the whole picture of the sensor.",
    )
    require(
        not is_tiled(values),
        where,
        expected="a raw mosaic, in which the four angles alternate from pixel to pixel",
        found="the same view four times, side by side",
        remedy="Save the output of the sensor (a pixel format such as Mono12 or BayerRG12), not one with separate "
        "angles; or cut the file into four shots, NAME_0, NAME_45, NAME_90 and NAME_135.",
    )


def _read_plain(path: Path, raw: RawFormat) -> NDArray[Any]:
    values = read_array(path) if path.suffix.lower() == ".npy" else decode_stored(path, read_picture(path))
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    require(
        values.ndim == 2 and values.dtype in (np.uint8, np.uint16) and 0 not in values.shape,
        path,
        expected="a raw mosaic: one channel of 8- or 16-bit whole numbers",
        found=array_kind(values),
        remedy="Save the output of the sensor before any demosaicing or conversion to color.",
    )
    size = (values.shape[1], values.shape[0])
    expected = (raw.width or size[0], raw.height or size[1])
    require(
        size == expected,
        path,
        expected=f"{expected[0]}x{expected[1]} pixels, as specified by --width and --height",
        found=f"{size[0]}x{size[1]}",
        remedy="Omit the two options for files that state their size.",
    )
    return values


def _read_packed(path: Path, data: bytes, raw: RawFormat) -> NDArray[Any]:
    if raw.width is None or raw.height is None or raw.packing is None:
        flags = {"--width": raw.width, "--height": raw.height, "--packing": raw.packing}
        raise PolarguideError(
            path,
            expected="width, height and packing of a .raw file",
            found=f"no {', '.join(flag for flag, value in flags.items() if value is None)}",
            remedy=f"Specify the settings of the camera; packings are {', '.join(PACKINGS)} and are never guessed.",
        )
    size = packed_size(raw.width, raw.height, raw.packing)
    require(
        len(data) == size,
        path,
        expected=f"{size} bytes for {raw.width}x{raw.height} pixels in {raw.packing}",
        found=f"{len(data)}",
        remedy="Check --width, --height and --packing; a short file may be truncated.",
    )
    values = unpack(data, raw.width, raw.height, raw.packing)
    _require_smooth(path, data, values, raw.packing)
    return values


_CELLS = 4
"""Side of the blocks whose means are compared, in pixels. Each block has all angles and colors of any sensor."""
_LEAST_BLOCKS = 8
"""Smallest number of blocks along a side of a quarter of the picture. Fewer blocks may correlate by chance."""
_MOST_BLOCKS = 128
"""Largest number of blocks along a side of a quarter of the picture that are compared."""
_TILED = 0.4
"""Correlation of the detail of the quarters above which they show the same view.

The correlation is more than 0.55 for four pictures of one view, and at most 0.2 for other pictures.
"""


def is_tiled(values: NDArray[Any]) -> bool:
    """Return True if a picture consists of four small pictures of the same view, in two rows of two.

    Some cameras display the four angles in this way. The detail of each quarter is correlated with that of the first
    quarter. The detail is the mean of each block minus the mean of the neighboring blocks.
    """
    down, across = (min(side // 2 // _CELLS, _MOST_BLOCKS) for side in values.shape)
    if min(down, across) < _LEAST_BLOCKS:
        return False
    half = [side // 2 for side in values.shape]
    detail = []
    for row, column in ((0, 0), (0, half[1]), (half[0], 0), (half[0], half[1])):
        part = values[row : row + down * _CELLS, column : column + across * _CELLS]
        # Sums of 16 values of 16 bits are whole numbers of 20 bits, which single precision represents.
        rows = part.reshape(down, _CELLS, across * _CELLS).sum(axis=1, dtype=np.float32)
        means = rows.reshape(down, across, _CELLS).sum(axis=2).astype(np.float64) / _CELLS**2
        around = sum(np.roll(means, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1))
        # Logarithms of ratios do not depend on the brightness of a quarter.
        fine = np.log((means + 1) / (around / 9 + 1))[1:-1, 1:-1].ravel()
        detail.append(fine - fine.mean())
    first, *others = (fine / max(float(np.linalg.norm(fine)), 1e-12) for fine in detail)
    return min(float(first @ other) for other in others) > _TILED


_APART = 4
"""Distance in pixels between samples that have the same angle and color on every sensor."""
_ROUGHER = 2.0
"""Ratio of the roughness of two packings above which the packing with the larger roughness is wrong."""


def _worst_roughness(values: NDArray[Any]) -> float:
    """Measure the roughness of the even columns and of the odd columns, and return the larger value.

    Roughness is the mean difference of neighboring samples of one angle, relative to the mean difference of any two
    samples. A wrong packing may affect only the even or only the odd columns.
    """
    return max(_roughness(values[:, column::2]) for column in (0, 1))


def _roughness(columns: NDArray[Any]) -> float:
    apart = _APART // 2
    rows = columns[: len(columns) // (2 * _APART) * 2 * _APART].astype(np.float32)
    rows = rows.reshape(-1, 2 * _APART, columns.shape[1])[:, [0, _APART]]
    if not len(rows) or columns.shape[1] <= apart:
        return 0.0
    near = (
        np.abs(rows[..., apart:] - rows[..., :-apart]).mean() + np.abs(rows[:, 1] - rows[:, 0]).mean()
    ) / 2
    ordered = np.sort(rows, axis=None)
    # The mean difference of any two of n samples follows from their ranks (Gini).
    place = np.arange(1, ordered.size + 1, dtype=np.float64)
    spread = 2 * float((2 * place - ordered.size - 1) @ ordered) / ordered.size**2
    return float(near / spread) if spread > 0 else 0.0


def _require_smooth(path: Path, data: bytes, values: NDArray[Any], packing: Packing) -> None:
    """Refuse a packing or a size with which the data look like noise, if they look like a picture with another one.

    Raises:
        PolarguideError: another packing or size gives a smoother picture.
    """
    height, width = values.shape
    others: dict[str, tuple[int, int, Packing]] = {
        f"--packing {other}": (width, height, other)
        for other in PACKINGS
        if other != packing and packed_size(width, height, other) == len(data)
    }
    if width != height:
        others[f"--width {height} --height {width}"] = (height, width, packing)
    own = _worst_roughness(values)
    rough = {options: _worst_roughness(unpack(data, *other)) for options, other in others.items()}
    # The smoothest packing is suggested, because two packings that differ only in the low bits are both smooth.
    for options in sorted(rough, key=lambda options: rough[options])[:1]:
        require(
            not own > _ROUGHER * rough[options] > 0,
            path,
            expected="a picture with similar neighbors behind one analyzer",
            found=f"noise with --packing {packing} at {width}x{height}",
            remedy=f"Read the file with {options}.",
        )
