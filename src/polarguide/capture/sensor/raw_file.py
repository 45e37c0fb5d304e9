"""Read raw mosaics: pictures, arrays, and the packed pixels of GenICam and GigE Vision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.arrays import array_kind, read_array
from polarguide.capture.formats.pictures import decode_stored, read_picture, stated_full_scale
from polarguide.capture.sensor.pattern import Packing
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file

PACKINGS: dict[Packing, tuple[int, int, int]] = {
    "8": (1, 1, 8), "16": (2, 1, 16), "16be": (2, 1, 16),
    "10p": (5, 4, 10), "10packed": (3, 2, 10), "10mipi": (5, 4, 10),
    "12p": (3, 2, 12), "12packed": (3, 2, 12), "12mipi": (3, 2, 12),
}  # fmt: skip
"""Bytes of a group, pixels of a group, bits of a pixel."""


def packed_size(width: int, height: int, packing: Packing) -> int:
    """Bytes of a packed picture: rows follow one another without padding, the last group is filled up."""
    group, pixels, _ = PACKINGS[packing]
    return -(-width * height // pixels) * group


def unpack(data: bytes, width: int, height: int, packing: Packing) -> NDArray[Any]:
    """Unpack a picture.

    ``8`` and ``16`` are whole bytes, the low one first, ``16be`` the high one. ``10p`` and ``12p`` are little-endian
    bit streams, low bits first: bit b of pixel k is bit ``bits * k + b`` of the file (GenICam PFNC). The others have
    the high eight bits of each pixel in a byte. In ``10packed`` and ``12packed`` (GigE Vision) these are bytes 0 and 2
    of two pixels; the low bits of the first are the lowest of byte 1, those of the second begin at its bit 4. In
    ``10mipi`` and ``12mipi`` (MIPI CSI-2) the last byte of a group has the low bits of its pixels in turn.

    Args:
        data: exactly ``packed_size`` bytes.
        width, height: size of the picture.
        packing: a key of ``PACKINGS``.

    Returns:
        [height, width] values from 0 to 2^bits - 1, uint16 but for ``8``.
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
    """Size and packing of a packed file, which does not contain them. Other files do not need them."""

    width: int | None = None
    height: int | None = None
    packing: Packing | None = None

    def container(self, path: Path, kind: np.dtype[Any]) -> int:
        """Bits that a pixel of type ``kind`` takes in a file."""
        packing = self.packing if path.suffix.lower() == ".raw" else None
        return kind.itemsize * 8 if packing is None else PACKINGS[packing][2]

    def full_scale(self, path: Path, values: NDArray[Any]) -> int | None:
        """The full scale that a file states for its values [H, W], as ``stated_full_scale``."""
        if path.suffix.lower() in (".raw", ".npy"):
            return None
        with open(path, "rb") as file:
            return stated_full_scale(path, file, values)


def read_mosaic(path: Path, raw: RawFormat, *, least: int = 1) -> NDArray[Any]:
    """Read one raw mosaic.

    Args:
        path: a PNG, TIFF, ``.npy`` or packed ``.raw`` file.
        raw: size and packing of a ``.raw`` file; where it gives a size, other files must have it too.
        least: pixels that the shorter side must have.

    Returns:
        [H, W] uint8 or uint16, the values as stored.

    Raises:
        PolarguideError: the file cannot be read, is damaged, has color channels or another size, is too small, or holds
            four pictures.
    """
    packed = path.suffix.lower() == ".raw"
    values = _read_packed(path, read_file(path), raw) if packed else _read_plain(path, raw)
    require_mosaic(path, values, least=least)
    return values


def require_mosaic(where: Path | str, values: NDArray[Any], *, least: int) -> None:
    """Refuse values [H, W] that no sensor delivers; ``least``: pixels that the shorter side must have.

    Raises:
        PolarguideError: the values are too few, or four pictures side by side.
    """
    if min(values.shape) < least:
        raise PolarguideError(
            where,
            expected=f"a mosaic of at least {least}x{least} pixels",
            found=f"{values.shape[1]}x{values.shape[0]}",
            remedy="Give the whole picture of the sensor.",
        )
    if is_tiled(values):
        raise PolarguideError(
            where,
            expected="a raw mosaic, in which the four angles take turns from pixel to pixel",
            found="the same view four times, side by side",
            remedy="Save what the sensor delivers (a pixel format such as Mono12 or BayerRG12), not one that shows the "
            "four angles apart; or cut the file into four shots, NAME_0, NAME_45, NAME_90 and NAME_135.",
        )


def _read_plain(path: Path, raw: RawFormat) -> NDArray[Any]:
    suffix = path.suffix.lower()
    values = read_array(path) if suffix == ".npy" else decode_stored(path, read_picture(path))
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
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


def _read_packed(path: Path, data: bytes, raw: RawFormat) -> NDArray[Any]:
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
    values = unpack(data, raw.width, raw.height, raw.packing)
    _require_alike_neighbors(path, data, values, raw.packing)
    return values


_CELLS = 4
"""Pixels along a block whose mean is free of analyzers and colors on every sensor."""
_LEAST_BLOCKS = 8
"""Blocks along a quarter of the picture; fewer correlate by chance."""
_MOST_BLOCKS = 128
"""Blocks that are compared at most."""
_TILED = 0.4
"""Correlation of the detail in every quarter with that in the first: over 0.55 of one view, 0.2 at most of others."""


def is_tiled(values: NDArray[Any]) -> bool:
    """Whether a picture holds the same view four times, in two rows of two, as cameras show the four angles apart.

    The detail (means of blocks less those of the blocks around) of each quarter is compared with that of the first.
    """
    down, across = (min(side // 2 // _CELLS, _MOST_BLOCKS) for side in values.shape)
    if min(down, across) < _LEAST_BLOCKS:
        return False
    half = [side // 2 for side in values.shape]
    detail = []
    for row, column in ((0, 0), (0, half[1]), (half[0], 0), (half[0], half[1])):
        part = values[row : row + down * _CELLS, column : column + across * _CELLS]
        # Sums of 16 values of 16 bits are whole numbers of 20, which single precision holds.
        rows = part.reshape(down, _CELLS, across * _CELLS).sum(axis=1, dtype=np.float32)
        means = rows.reshape(down, across, _CELLS).sum(axis=2).astype(np.float64) / _CELLS**2
        around = sum(np.roll(means, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1))
        # Logarithms of ratios: a quarter that is brighter everywhere has the same detail.
        fine = np.log((means + 1) / (around / 9 + 1))[1:-1, 1:-1].ravel()
        detail.append(fine - fine.mean())
    first, *others = (fine / max(float(np.linalg.norm(fine)), 1e-12) for fine in detail)
    return min(float(first @ other) for other in others) > _TILED


_APART = 4
"""Pixels after which analyzer and color are the same on every sensor."""
_ROUGHER = 2.0
"""A reading whose neighbors differ this many times as much as those of another one is not how the file was written."""


def roughness(values: NDArray[Any]) -> float:
    """Mean difference of neighbors behind one analyzer, as a share of that of samples that have nothing in common; of
    the even or the odd columns, whichever is larger: a wrong packing may leave every other sample nearly right.
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
    # The mean difference of any two of n samples, by their places in order (Gini).
    place = np.arange(1, ordered.size + 1, dtype=np.float64)
    spread = 2 * float((2 * place - ordered.size - 1) @ ordered) / ordered.size**2
    return float(near / spread) if spread > 0 else 0.0


def _require_alike_neighbors(path: Path, data: bytes, values: NDArray[Any], packing: Packing) -> None:
    """Refuse a packing or a size that makes noise of a picture, where another one of the same bytes does not.

    Raises:
        PolarguideError: there is such a one.
    """
    height, width = values.shape
    others: dict[str, tuple[int, int, Packing]] = {
        f"--packing {other}": (width, height, other)
        for other in PACKINGS
        if other != packing and packed_size(width, height, other) == len(data)
    }
    if width != height:
        others[f"--width {height} --height {width}"] = (height, width, packing)
    mine = roughness(values)
    rough = {options: roughness(unpack(data, *other)) for options, other in others.items()}
    # The smoothest one: of two packings that differ in the low bits alone, both are smooth.
    for options in sorted(rough, key=lambda options: rough[options])[:1]:
        if mine > _ROUGHER * rough[options] > 0:
            raise PolarguideError(
                path,
                expected="a picture, in which neighbors behind one analyzer are alike",
                found=f"noise with --packing {packing} at {width}x{height}",
                remedy=f"Read the file with {options}.",
            )
