"""Read the raw mosaics of a polarization sensor, and convert their values to linear intensities.

Files are pictures, arrays, or packed pixels of industrial cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.brackets import Bracket, Radiance, measure_exposures, merge
from polarguide.capture.calibration import pair_ratio
from polarguide.capture.formats.pictures import array_kind, read_array
from polarguide.capture.formats.stored import decode_stored, read_picture, stated_full_scale
from polarguide.capture.layout import require_memory, require_memory_of_each
from polarguide.capture.raw_options import RawMosaicOptions
from polarguide.capture.sensor.analyzers import AnalyzerCalibration, read_analyzers, spread_to_cells
from polarguide.capture.sensor.pattern import (
    SENSOR_NAMES,
    SENSOR_SIZES,
    Levels,
    Packing,
    sensor_pattern,
    tiled,
    unusable_samples,
)
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import read_file, require_file
from polarguide.geometry.polarizer import ANGLES

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


QUARTER_FLIPS = ("90", "270")
"""Values of the option ``flip`` that specify a rotation by 90 degrees or 270 degrees counter-clockwise."""
SMALLEST = 16
"""Smallest length of the shorter side of a mosaic in pixels."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Number of bytes per sensor pixel that the development of a mosaic takes at least, by demosaicing mode."""


class MosaicFiles:
    """Reader of the raw mosaics of one sensor, which also converts their values to linear intensities.

    Attributes:
        pattern: pattern of the sensor, starting at the top-left pixel of a mosaic after ``cut``.
        crop: number of columns and rows that ``cut`` removes at the left and top.
        corner: column and row of the sensor at which a mosaic starts after ``cut``.
        analyzers: calibration of the sensor, or None.
    """

    def __init__(self, options: RawMosaicOptions) -> None:
        """Create a reader with the sensor, region, packing, dark frame and calibration of the options.

        Raises:
            PolarguideError: the sensor is missing, or the calibration is damaged or belongs to another sensor.
        """
        if options.sensor is None:
            raise PolarguideError(
                "--sensor",
                expected=f"the sensor of raw mosaics: {SENSOR_NAMES}",
                found="none",
                remedy="Name the sensor: color and monochrome sensors have different patterns.",
            )
        self._options = options
        self._sensor = options.sensor
        self._raw = RawFormat(options.width, options.height, options.packing)
        pattern = sensor_pattern(options.sensor).shifted(options.offset_x, options.offset_y)
        self.crop = pattern.cell_corner()
        self.pattern = pattern.shifted(*self.crop)
        self.corner = (options.offset_x + self.crop[0], options.offset_y + self.crop[1])
        self.analyzers = calibration_of(options)

    def read(self, where: Path | str, values: NDArray[Any] | None = None) -> NDArray[Any]:
        """Read the stored values [H, W] of a whole mosaic, and return them in the orientation of the sensor.

        Args:
            where: path of the file, or a name for messages if the mosaic is in memory.
            values: mosaic in memory, uint8 or uint16. By default, the file ``where`` is read.

        Raises:
            PolarguideError: the file is unreadable, too small, or a grid of four pictures. Or the mosaic does not fit
                into memory, or is larger than the calibrated region.
        """
        if values is None:
            self._require_memory(Path(where))
            values = read_mosaic(Path(where), self._raw, least=SMALLEST)
        else:
            require_mosaic(where, values, least=SMALLEST)
        values = self._turned_back(where, values)
        if self.analyzers is not None:
            self.analyzers.require_region(
                (self._options.offset_x, self._options.offset_y), values.shape[::-1], self._options.analyzers
            )
        return values

    def _require_memory(self, path: Path) -> None:
        worked = WORKED[self._options.demosaic]
        raw = self._raw
        remedy = "Specify a region of the sensor, or choose --demosaic half or quarter."
        if path.suffix.lower() != ".raw":
            require_memory_of_each([path], worked, "a mosaic", remedy=remedy)
        elif raw.width is not None and raw.height is not None:
            require_memory(
                path, worked * raw.width * raw.height, f"a mosaic of {raw.width}x{raw.height}", remedy=remedy
            )

    def _turned_back(self, where: Path | str, values: NDArray[Any]) -> NDArray[Any]:
        """Undo the mirroring or rotation of a mosaic that the option ``flip`` specifies.

        Raises:
            PolarguideError: the mosaic is wider or higher than the sensor, possibly because it was rotated.
        """
        flip = self._options.flip
        if flip in QUARTER_FLIPS:
            values = np.rot90(values, -1 if flip == "90" else 1)
        width, height = SENSOR_SIZES[self._sensor]
        left = self._options.offset_x
        top = self._options.offset_y
        rows, columns = values.shape
        if columns > width - left or rows > height - top:
            rotated = rows <= width and columns <= height and flip not in QUARTER_FLIPS
            raise PolarguideError(
                where,
                expected=f"a mosaic in the orientation of the sensor, at most {width - left}x{height - top} pixels of "
                f"{self._sensor}",
                found=f"{columns}x{rows}" + (", probably rotated by 90 degrees" if rotated else ""),
                remedy="Use --flip 90 if the mosaic was rotated counter-clockwise, --flip 270 if clockwise."
                if rotated
                else "Check --sensor, --offset-x and --offset-y.",
            )
        values = values[:, ::-1] if flip in ("x", "xy") else values
        return values[::-1] if flip in ("y", "xy") else values

    def depth(self, path: Path, values: NDArray[Any]) -> tuple[int, int | None]:
        """Return the number of bits per pixel in a file, and the full scale that the file states.

        The full scale is ``None`` if the file does not state it, or if the user specifies ``bits``.
        """
        stated = self._raw.full_scale(path, values) if self._options.bits is None else None
        return self._raw.container(path, values.dtype), stated

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop a mosaic [H, W] so that it consists of whole polarizer cells."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """Return the dark frame, cropped by ``cut``. Return None if the user specifies no dark frame."""
        if self._options.dark_frame is None:
            return None
        dark = self._turned_back(self._options.dark_frame, read_mosaic(self._options.dark_frame, self._raw))
        require(
            dark.shape == shape,
            self._options.dark_frame,
            expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
            found=f"{dark.shape[1]}x{dark.shape[0]}",
            remedy="Photograph it with the same region and settings, and with the lens covered.",
        )
        return self.cut(dark).astype(np.float32)

    def ratio_of_blocks(
        self,
        samples: list[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        shape: tuple[int, ...],
    ) -> float | None:
        """Measure the ratio of the pair sums in blocks of mosaics.

        Samples of different angles are at different pixels. Tent weights interpolate all of them to the center of
        a block of two periods, so gradients of the picture cancel in the ratio.

        Args:
            samples: blocks with a side of two periods from each mosaic, see ``sample_blocks``.
            levels: levels of the stored values.
            dark: dark frame, or None.
            shape: numbers of rows and columns of a mosaic after ``cut``.

        Returns:
            The ratio (I0 + I90) / (I45 + I135), or None if the blocks are too dark.
        """
        values = np.concatenate(samples)
        period = self.pattern.period
        floor = None if dark is None else np.tile(sample_blocks(dark, 2 * period), (len(samples), 1, 1))
        linear = levels.linear(values, floor).astype(np.float64)
        if self.analyzers is not None:
            of_cells = self.analyzers.correction(self.corner, (shape[1], shape[0]))
            cells = linear.reshape(len(samples), -1, period, 2, period, 2)
            planes = [cells[..., row, :, column].copy() for row, column in np.ndindex(2, 2)]
            for matrices, (row, column) in zip(of_cells, np.ndindex(2, 2), strict=True):
                parts = [sample_blocks(m, period) * plane for m, plane in zip(matrices, planes, strict=True)]
                cells[..., row, :, column] = sum(parts)
        rising = (np.arange(period) + 0.5) / period
        tent = np.concatenate([rising, rising[::-1]])
        weighted = linear * tent[:, None] * tent
        places = np.tile(self.pattern.angles, (2, 2))
        # The weights of each angle sum to the number of its samples in a period.
        angles = np.stack([weighted[:, places == angle].sum(axis=1) for angle in ANGLES])
        angles *= 4 / period**2
        base = levels.black if floor is None else floor
        usable = np.asarray((values < levels.saturation).all(axis=(1, 2)) & (values > base).any(axis=(1, 2)))
        return pair_ratio(angles, usable)

    def merged(
        self,
        bracket: Bracket,
        exposures: Sequence[NDArray[Any]],
        levels: Levels,
        dark: NDArray[np.float32] | None,
        part: tuple[slice, slice] | None = None,
    ) -> tuple[Radiance, NDArray[np.bool_]]:
        """Convert the stored values of a mosaic to linear intensities, and merge its exposures.

        Args:
            bracket: files of the exposures.
            exposures: stored values of each exposure after ``cut``, [H, W].
            levels: levels of the stored values.
            dark: dark frame [H, W], or None.
            part: rows and columns of the result; default: all. The exposures are measured in the whole mosaic.

        Returns:
            The linear intensities [H, W]; and the mask of samples that are dark in all exposures.

        Raises:
            PolarguideError: the exposures contradict each other, see ``measure_exposures``.
        """

        def linear(
            data: tuple[NDArray[Any], NDArray[np.float32] | None],
        ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            return levels.linear(*data), np.asarray(data[0] >= levels.saturation)

        measured = measure_exposures(bracket, [(values, dark) for values in exposures], linear)
        if part is not None:
            exposures = [np.ascontiguousarray(values[part]) for values in exposures]
            dark = None if dark is None else dark[part]
        radiance = merge([(values, dark) for values in exposures], linear, measured)
        black = [unusable_samples(values, levels, dark)[1] for values in exposures]
        return radiance, np.logical_and.reduce(black)

    def calibrated(
        self,
        linear: NDArray[np.float32],
        *masks: NDArray[np.bool_],
        corner: tuple[int, int] | None = None,
    ) -> tuple[NDArray[np.float32], tuple[NDArray[np.bool_], ...]]:
        """Apply the calibration to the linear intensities of a mosaic or a part of it.

        The calibration mixes the samples of a polarizer cell. If there is a calibration, masks of unusable samples are
        therefore extended to whole cells.

        Args:
            linear: linear intensities [H, W].
            masks: masks of unusable samples, [H, W] each.
            corner: column and row of the sensor at which the part starts; default: ``corner`` of the reader.

        Returns:
            The linear intensities [H, W], and the masks.
        """
        if self.analyzers is None:
            return linear, masks
        return self.analyzers.apply(linear, offset=corner or self.corner), tuple(map(spread_to_cells, masks))

    def sample_factors(
        self, shape: tuple[int, ...], gains: Sequence[float], scale: float = 1.0
    ) -> NDArray[np.float32]:
        """Return the factor by which each sample of a mosaic is multiplied, ``scale / gain`` of its angle, [H, W]."""
        of_angle = dict(zip(ANGLES, gains, strict=True))
        factors = np.vectorize(lambda angle: scale / of_angle[angle])(self.pattern.angles)
        return tiled(factors.astype(np.float32), shape)


def calibration_of(options: RawMosaicOptions) -> AnalyzerCalibration | None:
    """Read the calibration of the sensor. Return None if the options specify no calibration.

    The calibration is cached because many mosaics use it.

    Raises:
        PolarguideError: the file is missing, damaged or belongs to another sensor.
    """
    path = options.analyzers
    if path is None:
        return None
    require_file(path, expected="a file of polarguide calibrate", remedy="Check --calibration.")
    state = path.stat()
    calibration = _read_analyzers(path, state.st_mtime_ns, state.st_size)
    calibration.require_sensor(options.sensor, path)
    return calibration


@lru_cache(maxsize=1)
def _read_analyzers(path: Path, *_: int) -> AnalyzerCalibration:
    return read_analyzers(path)


_BLOCKS = 1024


def sample_blocks(values: NDArray[Any], size: int) -> NDArray[Any]:
    """Return N square blocks of a mosaic in a regular grid, [N, size, size]."""
    rows = values.shape[0] // size
    columns = values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    row, column = np.divmod(np.arange(0, rows * columns, max(1, rows * columns // _BLOCKS)), max(columns, 1))
    return grid.swapaxes(1, 2)[row, column]
