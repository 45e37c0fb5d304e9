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

from polarguide.capture.calibration import UNIDENTIFIED, oriented
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.datasets.dataset import Dataset, resized_mask
from polarguide.capture.develop import QUARTER_TURNS, MosaicFiles, gains_of, sample_blocks
from polarguide.capture.formats.pictures import stated_size
from polarguide.capture.layout import index_files
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic
from polarguide.capture.sensor.pattern import (
    FULL_16,
    SIDE,
    Levels,
    agreed_full_scale,
    estimate_levels,
    level_notes,
    unusable_samples,
)
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import EXACT, Rounding, rounding_of
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.preparation.settings import PrepareSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source, Stored

_JUDGED = 8
"""Mosaics of a capture that are looked through for defects of the sensor."""
_GAINS = {
    "dark": "The pictures are too dark to estimate the gains of the angles.",
    "off": "I0 + I90 is {:+.2%} off I45 + I135, too much for gains: not corrected. Check --sensor, --offset-x, "
    "--offset-y and --order.",
    "corrected": f"I0 + I90 is {{:+.2%}} off I45 + I135; corrected. {UNIDENTIFIED}",
}


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
        self._crop = self._mosaics.crop
        self._pattern = self._mosaics.pattern
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
        width = self._settings.width
        height = self._settings.height
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
        container = 0
        shape = None
        stated: dict[Path, int | None] = {}
        samples: list[NDArray[Any]] = []
        blocks: list[NDArray[Any]] = []
        for count, path in enumerate(self._files.values(), 1):
            values = self._mosaics.read(path)
            shape = shape or (values.shape, values.dtype)
            self._require_alike(path, values, shape)
            container, stated[path] = self._mosaics.depth(path, values)
            counts += np.bincount(values.ravel(), minlength=len(counts))
            cut = self._mosaics.cut(values)
            samples.append(sample_blocks(cut, 2 * self._pattern.period))
            blocks.append(sample_blocks(cut, SIDE))
            advance(count)
        assert shape is not None
        settings = self._settings
        occurring = np.flatnonzero(counts)
        full = agreed_full_scale(stated)
        levels = estimate_levels(
            int(occurring[-1]), int(np.bitwise_or.reduce(occurring)), container,
            bits=settings.bits, black=settings.black_level, saturation=settings.saturation, counts=counts, stated=full,
        )  # fmt: skip
        levels = replace(levels, gamma=settings.gamma if self._dataset is None else self._dataset.gamma)
        if self._dataset is None:
            self._mosaics.require_kind(np.concatenate(blocks), levels)
        dark = self._mosaics.dark(shape[0])
        ratio, colors = self._mosaics.light_of_blocks(samples, levels, dark, cut.shape)
        gains, notes = gains_of(ratio, settings, _GAINS if settings.gains == "auto" else {})
        notes += [] if self._dataset is None else self._dataset.notes
        notes += level_notes(levels, counts, container, settings.bits, full)
        standing_out = int(self._defects(levels).sum())
        if standing_out:
            notes.append(defects_note(standing_out, shape[0][0] * shape[0][1]))
        white = self._white or gray_world(colors)
        peak = max(white) / min(gains) * settings.calibration.peak
        analyzers = self._mosaics.analyzers
        if analyzers is not None:
            peak *= analyzers.peak(self._mosaics.corner, cut.shape[::-1])
        return {
            "levels": asdict(levels),
            "pattern": self._pattern.rows(),
            "crop": list(self._crop),
            "pair_ratio": ratio,
            "gains": list(gains),
            "analyzers": None if analyzers is None else analyzers.record(),
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
        linear, (bad,) = self._mosaics.linear(values, levels, dark, saturated | black | self._defects(levels))
        linear = linear * self._mosaics.sample_factors(
            values.shape, measured["gains"], measured["white_balance"], measured["scale"]
        )
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
