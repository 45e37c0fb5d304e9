"""Picture source: raw mosaics of a polarization sensor, one file per view."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import UNIDENTIFIED, UNIT_GAINS, balancing_gains, oriented, pair_ratio
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.datasets.dataset import Dataset, resized_mask
from polarguide.capture.formats.pictures import stated_size
from polarguide.capture.layout import index_files, require_memory, require_memory_of_each
from polarguide.capture.sensor.analyzer_file import read_analyzers
from polarguide.capture.sensor.analyzers import imbalance_notes, spread_to_cells
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic
from polarguide.capture.sensor.pattern import (
    FULL_16,
    SENSOR_NAMES,
    SENSOR_SIZES,
    SIDE,
    Levels,
    Pattern,
    agreed_full_scale,
    estimate_levels,
    level_notes,
    require_kind,
    sensor_pattern,
    tiled,
    unusable_samples,
)
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES, RawFormat, read_mosaic, require_mosaic
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.write import EXACT, Rounding, rounding_of
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.preparation.settings import PrepareSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source, Stored

QUARTER_TURNS = ("90", "270")
"""Of ``flip``: degrees counter-clockwise by which mosaics were turned."""
SMALLEST = 16
"""Pixels of the shorter side of a mosaic."""
WORKED = {"quarter": 16, "half": 60, "full": 240}
"""Bytes that a pixel of the sensor takes at least while a mosaic is developed, by the mode of demosaicing."""


class MosaicFiles:
    """How the mosaics of one sensor are read.

    Attributes:
        pattern: pattern of the top-left pixel that is left after ``cut``.
        crop: columns and rows that ``cut`` takes off.
    """

    def __init__(self, settings: PrepareSettings) -> None:
        """Take sensor, region, packing and dark frame from the settings.

        Raises:
            PolarguideError: the sensor is not named.
        """
        if settings.sensor is None:
            raise PolarguideError(
                "--sensor",
                expected=f"the sensor of raw mosaics: {SENSOR_NAMES}",
                found="none",
                remedy="Name it; color and monochrome sensors have different patterns.",
            )
        self._settings = settings
        self._sensor = settings.sensor
        self._raw = RawFormat(settings.width, settings.height, settings.packing)
        pattern = sensor_pattern(settings.sensor).shifted(settings.offset_x, settings.offset_y)
        self.crop = pattern.cell_corner()
        self.pattern = pattern.shifted(*self.crop)

    def read(self, path: Path) -> NDArray[Any]:
        """The stored values of a whole mosaic, [H, W], in the sensor's orientation: the camera's mirroring is undone.

        Raises:
            PolarguideError: the file cannot be read, is too small, or does not fit into memory when it is developed.
        """
        worked, raw = WORKED[self._settings.demosaic], self._raw
        remedy = "Give a region of the sensor, or choose --demosaic half or quarter."
        if path.suffix.lower() != ".raw":
            require_memory_of_each([path], worked, "a mosaic", remedy=remedy)
        elif raw.width is not None and raw.height is not None:
            what = f"a mosaic of {raw.width}x{raw.height}"
            require_memory(path, worked * raw.width * raw.height, what, remedy=remedy)
        return self._turned_back(path, read_mosaic(path, self._raw, least=SMALLEST))

    def given(self, values: NDArray[Any], where: str) -> NDArray[Any]:
        """The values of a whole mosaic in memory, [H, W] uint8 or uint16, as ``read`` gives those of a file.

        Raises:
            PolarguideError: the values are too few, or four pictures side by side.
        """
        require_mosaic(where, values, least=SMALLEST)
        return self._turned_back(where, values)

    def _turned_back(self, where: Path | str, values: NDArray[Any]) -> NDArray[Any]:
        """A stored mosaic without the mirroring or the quarter turn that ``flip`` names.

        Raises:
            PolarguideError: it fits the sensor on its side alone.
        """
        flip = self._settings.flip
        if flip in QUARTER_TURNS:
            return np.rot90(values, -1 if flip == "90" else 1)
        size = SENSOR_SIZES[self._sensor]
        across = values.shape
        if across[0] > size[1] and across[0] <= size[0] and across[1] <= size[1]:
            raise PolarguideError(
                where,
                expected=f"a mosaic as the sensor lies, at most {size[0]}x{size[1]} pixels",
                found=f"{across[1]}x{across[0]}, one that was turned by a quarter",
                remedy="Give --flip 90 if it was turned counter-clockwise before it was saved, 270 if clockwise.",
            )
        values = values[:, ::-1] if flip in ("x", "xy") else values
        return values[::-1] if flip in ("y", "xy") else values

    def container(self, path: Path, values: NDArray[Any]) -> int:
        """Bits that a pixel takes in the file."""
        return self._raw.container(path, values.dtype)

    def full_scale(self, path: Path, values: NDArray[Any]) -> int | None:
        """The full scale that a file states for its values; None where it does not, or where ``bits`` says it."""
        return self._raw.full_scale(path, values) if self._settings.bits is None else None

    def require_kind(self, blocks: NDArray[Any], levels: Levels) -> None:
        """Refuse mosaics of the other kind of sensor: nothing later would tell."""
        require_kind(self._sensor, blocks, levels)

    def cut(self, values: NDArray[Any]) -> NDArray[Any]:
        """Crop to whole cells."""
        values = values[self.crop[1] :, self.crop[0] :]
        return np.ascontiguousarray(values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2])

    def dark(self, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """The dark frame, cut like the mosaics."""
        if self._settings.dark_frame is None:
            return None
        dark = self._turned_back(self._settings.dark_frame, read_mosaic(self._settings.dark_frame, self._raw))
        if dark.shape != shape:
            raise PolarguideError(
                self._settings.dark_frame,
                expected=f"a dark frame of {shape[1]}x{shape[0]} pixels like the mosaics",
                found=f"{dark.shape[1]}x{dark.shape[0]}",
                remedy="Take it with the same region and settings, the lens covered.",
            )
        return self.cut(dark).astype(np.float32)


_BLOCKS = 1024
_JUDGED = 8
"""Mosaics of a capture that are looked through for defects of the sensor."""


def sample_blocks(values: NDArray[Any], size: int) -> NDArray[Any]:
    """A regular subset of a mosaic's blocks, [N, size, size]."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    grid = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    row, column = np.divmod(np.arange(0, rows * columns, max(1, rows * columns // _BLOCKS)), max(columns, 1))
    return grid.swapaxes(1, 2)[row, column]


def block_intensities(
    samples: list[NDArray[Any]],
    levels: Levels,
    floor: NDArray[np.float32] | None,
    pattern: Pattern,
    matrices: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Intensities at the centers of blocks: by angle [4, N], by color [3, N], and whether each is usable [N].

    Samples of different angles lie beside one another; weights that interpolate all of them to the center of a
    block of two periods keep gradients of the picture out of the ratio of the pair sums.

    Args:
        samples: ``sample_blocks`` of two periods from each mosaic.
        levels: levels of the capture.
        floor: ``sample_blocks`` of the dark frame, or None.
        pattern: pattern of the mosaics.
        matrices: [4, 4, ...]: ``sample_blocks`` of the corrections of cells, in blocks of one period, or None.
    """
    values = np.concatenate(samples)
    dark = None if floor is None else np.tile(floor, (len(samples), 1, 1))
    linear = levels.linear(values, dark).astype(np.float64)
    period = pattern.period
    if matrices is not None:
        cells = linear.reshape(len(samples), -1, period, 2, period, 2)
        planes = [cells[..., row, :, column].copy() for row, column in np.ndindex(2, 2)]
        for index, (row, column) in enumerate(np.ndindex(2, 2)):
            done = sum(matrices[index, other] * plane for other, plane in enumerate(planes))
            cells[..., row, :, column] = done
    rising = (np.arange(period) + 0.5) / period
    tent = np.concatenate([rising, rising[::-1]])
    weighted = linear * tent[:, None] * tent
    places = np.tile(pattern.angles, (2, 2))
    # The weights of one angle and color add up to 1 a sample of the period.
    angles = np.stack([weighted[:, places == angle].sum(axis=1) for angle in ANGLES])
    angles *= 4 / period**2
    colors = np.ones((3, len(values)))
    if pattern.colors is not None:
        filters = np.tile(pattern.colors, (2, 2))
        colors = np.stack([weighted[:, filters == c].sum(axis=1) for c in range(3)]) / [[4], [8], [4]]
    base = levels.black if dark is None else dark
    usable = (values < levels.saturation).all(axis=(1, 2)) & (values > base).any(axis=(1, 2))
    return angles, colors, np.asarray(usable)


def gray_world(colors: NDArray[np.float64]) -> tuple[float, float, float]:
    """Gains that make the mean of [3, N] colors gray; green keeps its own."""
    mean = np.maximum(colors.mean(axis=1) if colors.size else np.ones(3), 1e-6)
    return float(mean[1] / mean[0]), 1.0, float(mean[1] / mean[2])


class MosaicSource(Source):
    """Raw mosaics of a division-of-focal-plane sensor."""

    needs = ("levels", "gains", "white_balance", "scale")

    def __init__(self, root: Path, settings: PrepareSettings, dataset: Dataset | None = None) -> None:
        """Find the files.

        Args:
            root: the folder of mosaics.
            settings: settings of the preparation.
            dataset: the published dataset of the mosaics, if they belong to one.

        Raises:
            PolarguideError: the sensor is not named, or a setting does not fit it.
        """
        self.kind = "mosaic" if dataset is None else dataset.name
        self.cameras = None if dataset is None else dataset.cameras
        self._dataset = dataset
        self._mosaics = MosaicFiles(settings)
        self._settings = settings
        self._dark_path = settings.dark_frame
        files = index_files(root, RAW_SUFFIXES)
        if self._dark_path is not None:
            dark = os.path.realpath(self._dark_path)
            files = {view: path for view, path in files.items() if os.path.realpath(path) != dark}
        names = files.keys() if dataset is None else dataset.views
        self._files = {view: files[view] for view in sorted(names)}
        self.views = list(self._files)
        self.paths = list(self._files.values() if dataset is None else dataset.paths)
        self.paths += [path for path in (self._dark_path, settings.analyzers) if path is not None]
        self._analyzers = None if settings.analyzers is None else read_analyzers(settings.analyzers)
        if self._analyzers is not None:
            self._analyzers.require_sensor(settings.sensor, settings.analyzers)
        self._crop, self._pattern = self._mosaics.crop, self._mosaics.pattern
        self._corner = (settings.offset_x + self._crop[0], settings.offset_y + self._crop[1])
        self._white = white_gains(settings.white_balance)
        self._defective: NDArray[np.bool_] | None = None
        if self._pattern.colors is None and settings.white_balance != "none":
            raise PolarguideError(
                "--white-balance",
                expected="none for a monochrome sensor",
                found=settings.white_balance,
                remedy="Omit it.",
            )

    def stored(self, view: str) -> Stored:
        """By the header of the mosaic, or as the settings say."""
        width, height = self._settings.width, self._settings.height
        stated = None if width is None or height is None else (width, height)
        size = stated_size(self._files[view]) or stated
        if size is not None and self._settings.flip in QUARTER_TURNS:
            size = size[::-1]
        step = DEMOSAIC_MODES[self._settings.demosaic]
        if size is None or step == 1:
            return Stored(size)
        across, down = ((side - cut) // 2 * 2 // step for side, cut in zip(size, self._crop, strict=True))
        return Stored(size, developed=(across, down))

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Levels, gains of the angles and white balance of the capture; every file is read once."""
        counts = np.zeros(FULL_16 + 1, np.int64)
        container, shape = 0, None
        stated: dict[Path, int | None] = {}
        samples: list[NDArray[Any]] = []
        blocks: list[NDArray[Any]] = []
        for count, path in enumerate(self._files.values(), 1):
            values = self._mosaics.read(path)
            shape = shape or (values.shape, values.dtype)
            self._require_alike(path, values, shape)
            if self._analyzers is not None and count == 1:
                offset = (self._settings.offset_x, self._settings.offset_y)
                self._analyzers.require_region(offset, values.shape[::-1], self._settings.analyzers)
            container = self._mosaics.container(path, values)
            stated[path] = self._mosaics.full_scale(path, values)
            counts += np.bincount(values.ravel(), minlength=len(counts))
            samples.append(sample_blocks(self._mosaics.cut(values), 2 * self._pattern.period))
            blocks.append(sample_blocks(self._mosaics.cut(values), SIDE))
            advance(count)
        assert shape is not None
        settings = self._settings
        occurring, full = np.flatnonzero(counts), agreed_full_scale(stated)
        levels = estimate_levels(
            int(occurring[-1]), int(np.bitwise_or.reduce(occurring)), container,
            bits=settings.bits, black=settings.black_level, saturation=settings.saturation, counts=counts, stated=full,
        )  # fmt: skip
        levels = replace(levels, gamma=settings.gamma if self._dataset is None else self._dataset.gamma)
        if self._dataset is None:
            self._mosaics.require_kind(np.concatenate(blocks), levels)
        dark = self._mosaics.dark(shape[0])
        floor = None if dark is None else sample_blocks(dark, 2 * self._pattern.period)
        width, height = ((shape[0][axis] - self._crop[1 - axis]) // 2 * 2 for axis in (1, 0))
        matrices, brighter = None, 1.0
        if self._analyzers is not None:
            cells = self._analyzers.correction(self._corner, (width, height))
            matrices = np.stack(
                [[sample_blocks(cell, self._pattern.period) for cell in row] for row in cells]
            )
            brighter = self._analyzers.peak(self._corner, (width, height))
        angles, colors, usable = block_intensities(samples, levels, floor, self._pattern, matrices)
        ratio = pair_ratio(angles, usable)
        gains, notes = self._gains(ratio)
        notes += [] if self._dataset is None else self._dataset.notes
        notes += level_notes(levels, counts, container, settings.bits, full)
        standing_out = int(self._defects(levels).sum())
        if standing_out:
            notes.append(defects_note(standing_out, shape[0][0] * shape[0][1]))
        white = self._white or gray_world(colors[:, usable])
        peak = max(white) / min(gains) * settings.calibration.peak * brighter
        return {
            "levels": asdict(levels),
            "pattern": self._pattern.rows(),
            "crop": list(self._crop),
            "pair_ratio": ratio,
            "gains": list(gains),
            "analyzers": None if self._analyzers is None else self._analyzers.record(),
            "white_balance": list(white),
            "scale": 1.0 / max(1.0, peak),
            "rounding": self._rounding(levels, min(white) / max(gains) / max(1.0, peak)),
            "defects": standing_out,
            "notes": notes,
        }

    def _defects(self, levels: Levels) -> NDArray[np.bool_]:
        """The samples of a mosaic, cut to whole cells, that are no measure of light; saturated ones are told later."""
        if self._defective is None:
            files = list(self._files.values())
            judged = files[:: max(1, math.ceil(len(files) / _JUDGED))]
            mosaics = (
                np.minimum(self._mosaics.cut(self._mosaics.read(path)), levels.white) for path in judged
            )
            self._defective = defects(mosaics, self._pattern.period)
        return self._defective

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one mosaic: validity, levels, gains, then demosaicing, then the sense of the angles."""
        path = self._files[view]
        stored = self._mosaics.read(path)
        dark = self._mosaics.dark(stored.shape)
        values = self._mosaics.cut(stored)
        levels = msgspec.convert(measured["levels"], Levels)
        saturated, black = unusable_samples(values, levels, dark)
        bad, linear = saturated | black | self._defects(levels), levels.linear(values, dark)
        if self._analyzers is not None:
            linear, bad = self._analyzers.apply(linear, offset=self._corner), spread_to_cells(bad)
        linear = linear * self._sample_gains(values.shape, measured)
        settings = self._settings
        picture = demosaic(
            linear, bad, self._pattern,
            mode=settings.demosaic, interpolation=settings.interpolation, registered=settings.register,
        )  # fmt: skip
        intensities = oriented(np.clip(picture.intensities, 0.0, 1.0), settings.calibration)
        height, width = picture.invalid.shape
        return DevelopedView(
            intensities=intensities,
            invalid=picture.invalid,
            geometry=Geometry(
                stored.shape[::-1], self._crop, DEMOSAIC_MODES[settings.demosaic], (width, height)
            ),
            record={
                "clipped_share": round(float(saturated.mean()), 6),
                "dark_share": round(float(black.mean()), 6),
                "invalid_share": round(float(picture.invalid.mean()), 6),
            },
            mask=None if self._dataset is None else resized_mask(self._dataset, view, (height, width)),
        )

    def _rounding(self, levels: Levels, factor: float) -> Rounding:
        """Rounding of codes, by the smallest factor that a sample is multiplied by."""
        if self._settings.precision == "full" or levels.gamma != 1.0:
            return EXACT
        return rounding_of(np.array([0.0, FULL_CODE * factor / ((1 << levels.bits) - 1)]))

    def _require_alike(self, path: Path, values: NDArray[Any], first: tuple[Any, Any]) -> None:
        if (values.shape, values.dtype) != first:
            (height, width), kind = first
            raise PolarguideError(
                path,
                expected=f"{width}x{height} pixels of {kind}, as in the first file",
                found=f"{values.shape[1]}x{values.shape[0]} pixels of {values.dtype}",
                remedy="Prepare captures that differ in size or bit depth separately, each with its own --out.",
            )

    def _gains(self, ratio: float | None) -> tuple[tuple[float, float, float, float], list[str]]:
        """Gains of the angles, and notes about them."""
        settings = self._settings
        if self._analyzers is not None:
            return UNIT_GAINS, imbalance_notes(ratio)
        if settings.calibration.gains is not None:
            return settings.calibration.gains, []
        if settings.gains == "none":
            return UNIT_GAINS, []
        if ratio is None:
            return UNIT_GAINS, ["The pictures are too dark to estimate the gains of the angles."]
        gains = balancing_gains(ratio)
        deviation = f"I0 + I90 is {ratio - 1:+.2%} off I45 + I135"
        if gains is None:
            return UNIT_GAINS, [
                f"{deviation}, too much for gains: not corrected. Check --sensor, --offset-x, --offset-y and --order."
            ]
        return gains, [f"{deviation}; corrected. {UNIDENTIFIED}"]

    def _sample_gains(self, shape: tuple[int, ...], measured: dict[str, Any]) -> NDArray[np.float32]:
        """The factor of every sample, [H, W]."""
        pattern = self._pattern
        of_angle = dict(zip(ANGLES, measured["gains"], strict=True))
        gains = np.vectorize(lambda angle: measured["scale"] / of_angle[angle])(pattern.angles)
        if pattern.colors is not None:
            gains = gains * np.asarray(measured["white_balance"])[pattern.colors]
        return tiled(gains.astype(np.float32), shape)
