"""Picture source: raw mosaics of a polarization sensor, one file per view."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import UNIDENTIFIED, UNIT_GAINS, balancing_gains, oriented, pair_ratio
from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.datasets.dataset import Dataset, resized_mask
from polarguide.capture.layout import index_files
from polarguide.capture.sensor.analyzer_file import read_analyzers
from polarguide.capture.sensor.analyzers import spread_to_cells
from polarguide.capture.sensor.color_filters import SIDE
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, demosaic
from polarguide.capture.sensor.pattern import tiled
from polarguide.capture.sensor.radiometry import Levels, estimate_levels, unusable_samples
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.write import EXACT, Rounding, rounding_of
from polarguide.errors import PolarguideError
from polarguide.preparation.mosaic_files import MosaicFiles
from polarguide.preparation.mosaic_samples import block_intensities, gray_world, sample_blocks
from polarguide.preparation.settings import PrepareSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source
from polarguide.progress import Advance

CALIBRATED_IMBALANCE = 0.01
"""Of the pair sums of a calibrated sensor; more is a sign of another camera's calibration."""


class MosaicSource(Source):
    """Raw mosaics of a division-of-focal-plane sensor."""

    needs = ("levels", "gains", "white_balance", "scale")

    def __init__(self, root: Path, settings: PrepareSettings, dataset: Dataset | None = None) -> None:
        """Find the files.

        Args:
            root: the folder of mosaics.
            settings: of the preparation.
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
        if self._pattern.colors is None and settings.white_balance != "none":
            raise PolarguideError(
                "--white-balance",
                expected="none for a monochrome sensor",
                found=settings.white_balance,
                remedy="Omit it.",
            )

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Levels, gains of the angles and white balance of the capture; every file is read once."""
        largest = used = 0
        container, shape = 0, None
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
            largest, used = max(largest, int(values.max())), used | int(np.bitwise_or.reduce(values, None))
            samples.append(sample_blocks(self._mosaics.cut(values), 2 * self._pattern.period))
            blocks.append(sample_blocks(self._mosaics.cut(values), SIDE))
            advance(count)
        assert shape is not None
        asked = self._settings
        levels = estimate_levels(
            largest, used, container, bits=asked.bits, black=asked.black_level, saturation=asked.saturation
        )
        if self._dataset is not None:
            levels = replace(levels, gamma=self._dataset.gamma)
        else:
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
        if asked.bits is None and container == 16:
            notes.append(
                f"Values fill {levels.bits} bits (--bits says otherwise); {levels.white} is full scale."
            )
        white = self._white or gray_world(colors[:, usable])
        peak = max(white) / min(gains) * asked.calibration.peak * brighter
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
            "notes": notes,
        }

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one mosaic: validity, levels, gains, then demosaicing, then the sense of the angles."""
        path = self._files[view]
        stored = self._mosaics.read(path)
        dark = self._mosaics.dark(stored.shape)
        values = self._mosaics.cut(stored)
        levels = msgspec.convert(measured["levels"], Levels)
        saturated, black = unusable_samples(values, levels, dark)
        bad, linear = saturated | black, levels.linear(values, dark)
        if self._analyzers is not None:
            linear, bad = self._analyzers.apply(linear, offset=self._corner), spread_to_cells(bad)
        linear = linear * self._sample_gains(values.shape, measured)
        asked = self._settings
        picture = demosaic(
            linear, bad, self._pattern,
            mode=asked.demosaic, interpolation=asked.interpolation, registered=asked.register,
        )  # fmt: skip
        intensities = oriented(np.clip(picture.intensities, 0.0, 1.0), asked.calibration)
        height, width = picture.invalid.shape
        return DevelopedView(
            intensities=intensities,
            invalid=picture.invalid,
            geometry=Geometry(
                stored.shape[::-1], self._crop, DEMOSAIC_MODES[asked.demosaic], (width, height)
            ),
            record={
                "clipped_share": round(float(saturated.mean()), 6),
                "dark_share": round(float(black.mean()), 6),
                "invalid_share": round(float(picture.invalid.mean()), 6),
            },
            mask=None if self._dataset is None else resized_mask(self._dataset, view, (height, width)),
        )

    def _rounding(self, levels: Levels, factor: float) -> Rounding:
        """What codes are rounded to, with the smallest factor that a sample is multiplied by."""
        if self._settings.precision == "full" or levels.gamma != 1.0:
            return EXACT
        return rounding_of(np.array([0.0, FULL_CODE * factor / ((1 << levels.bits) - 1)]))

    def _require_alike(self, path: Path, values: NDArray[Any], first: tuple[Any, Any]) -> None:
        if (values.shape, values.dtype) != first:
            (height, width), kind = first
            raise PolarguideError(
                path,
                expected=f"{width}x{height} pixels of {kind} like the first file",
                found=f"{values.shape[1]}x{values.shape[0]} of {values.dtype}",
                remedy="Prepare captures of different size or depth one by one.",
            )

    def _gains(self, ratio: float | None) -> tuple[tuple[float, float, float, float], list[str]]:
        """Gains of the angles, and notes about them."""
        asked = self._settings
        if self._analyzers is not None:
            if ratio is None:
                return UNIT_GAINS, []
            notes = [f"With the calibration, I0 + I90 is {ratio - 1:+.2%} off I45 + I135."]
            if abs(ratio - 1) > CALIBRATED_IMBALANCE:
                notes.append("That is more than a calibration of this camera leaves: is it one of another?")
            return UNIT_GAINS, notes
        if asked.calibration.gains is not None:
            return asked.calibration.gains, []
        if asked.gains == "none":
            return UNIT_GAINS, []
        if ratio is None:
            return UNIT_GAINS, ["The pictures are too dark to estimate the gains of the angles."]
        gains = balancing_gains(ratio)
        said = f"I0 + I90 is {ratio - 1:+.2%} off I45 + I135"
        if gains is None:
            return UNIT_GAINS, [
                f"{said}, too much for gains: not corrected. Check --sensor, --offset-x, --offset-y and --order."
            ]
        return gains, [f"{said}; corrected. {UNIDENTIFIED}"]

    def _sample_gains(self, shape: tuple[int, ...], measured: dict[str, Any]) -> NDArray[np.float32]:
        """The factor of every sample, [H, W]."""
        pattern = self._pattern
        of_angle = dict(zip(ANGLES, measured["gains"], strict=True))
        gains = np.vectorize(lambda angle: measured["scale"] / of_angle[angle])(pattern.angles)
        if pattern.colors is not None:
            gains = gains * np.asarray(measured["white_balance"])[pattern.colors]
        return tiled(gains.astype(np.float32), shape)
