"""Picture source: raw mosaics of a polarization sensor, one file per view."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import UNIDENTIFIED, oriented
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.datasets.dataset import Dataset, resized_mask
from polarguide.capture.develop import (
    QUARTER_TURNS,
    MosaicFiles,
    levels_of_capture,
    pair_gains,
    sample_blocks,
)
from polarguide.capture.formats.pictures import stated_size
from polarguide.capture.layout import index_files
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic
from polarguide.capture.sensor.pattern import (
    FULL_16,
    SIDE,
    Levels,
    agreed_full_scale,
    require_kind,
    unusable_samples,
)
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import EXACT, rounding_of
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.preparation.journal import Factor, Measured, StoredRounding, ViewRecord
from polarguide.preparation.settings import MosaicSettings, white_gains
from polarguide.preparation.source import DevelopedView, Source, Stored

_JUDGED = 8
"""Mosaics of a capture that are looked through for defects of the sensor."""
_GAINS = {
    "dark": "The pictures are too dark to estimate the gains of the angles.",
    "off": "I0 + I90 is {:+.2%} off I45 + I135, too much for gains: not corrected. Check --sensor, --offset-x, "
    "--offset-y and --order.",
    "corrected": f"I0 + I90 is {{:+.2%}} off I45 + I135; corrected. {UNIDENTIFIED}",
}


class MosaicMeasured(Measured, kw_only=True):
    """Measurements of the mosaics of a capture.

    Attributes:
        levels: levels of the stored values. pattern: rows of the sensor's pattern. crop: columns and rows cut off.
        pair_ratio: ratio of the pair sums. gains: gains of the four angles. white_balance: gains of R, G and B.
        analyzers: calibration of the sensor. scale: factor of the linear values.
        rounding: rounding of codes. defects: number of defective samples.
    """

    levels: Levels
    pattern: tuple[str, ...] = ()
    crop: tuple[int, int] = (0, 0)
    pair_ratio: float | None = None
    gains: tuple[Factor, Factor, Factor, Factor]
    analyzers: dict[str, str] | None = None
    white_balance: tuple[Factor, Factor, Factor]
    scale: Factor
    rounding: StoredRounding = tuple(EXACT)
    defects: int = 0


class MosaicSource(Source):
    """Raw mosaics of a division-of-focal-plane sensor."""

    measured_type = MosaicMeasured

    def __init__(self, root: Path, settings: MosaicSettings, dataset: Dataset | None = None) -> None:
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

    def measure(self, advance: Advance) -> MosaicMeasured:
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
            if (values.shape, values.dtype) != shape:
                (height, width), kind = shape
                raise PolarguideError(
                    path,
                    expected=f"{width}x{height} pixels of {kind}, as in the first file",
                    found=f"{values.shape[1]}x{values.shape[0]} pixels of {values.dtype}",
                    remedy="Prepare captures that differ in size or bit depth separately, each with its own --out.",
                )
            container, stated[path] = self._mosaics.depth(path, values)
            counts += np.bincount(values.ravel(), minlength=len(counts))
            cut = self._mosaics.cut(values)
            samples.append(sample_blocks(cut, 2 * self._pattern.period))
            blocks.append(sample_blocks(cut, SIDE))
            advance(count)
        assert shape is not None
        settings = self._settings
        full = agreed_full_scale(stated)
        levels, counted = levels_of_capture(
            counts, container, settings, black=settings.black_level, stated=full
        )
        levels = replace(levels, gamma=settings.gamma if self._dataset is None else self._dataset.gamma)
        if self._dataset is None:
            assert settings.sensor is not None
            require_kind(settings.sensor, np.concatenate(blocks), levels)
        dark = self._mosaics.dark(shape[0])
        ratio, colors = self._mosaics.light_of_blocks(samples, levels, dark, cut.shape)
        analyzers = self._mosaics.analyzers
        gains, notes = pair_gains(
            ratio,
            settings,
            _GAINS if settings.gains == "auto" else {},
            calibrated=analyzers is not None,
        )
        notes += [] if self._dataset is None else self._dataset.notes
        notes += counted
        standing_out = int(self._defects(levels).sum())
        if standing_out:
            notes.append(defects_note(standing_out, shape[0][0] * shape[0][1]))
        mean = np.maximum(colors.mean(axis=1) if colors.size else np.ones(3), 1e-6)
        white = self._white or (float(mean[1] / mean[0]), 1.0, float(mean[1] / mean[2]))
        peak = max(white) / min(gains) * settings.calibration.peak
        if analyzers is not None:
            peak *= analyzers.peak(self._mosaics.corner, cut.shape[::-1])
        rounding = EXACT
        if settings.precision == "source" and levels.gamma == 1.0:
            # By the smallest factor that a sample is multiplied by.
            factor = min(white) / max(gains) / max(1.0, peak)
            rounding = rounding_of(np.array([0.0, FULL_CODE * factor / ((1 << levels.bits) - 1)]))
        return MosaicMeasured(
            levels=levels,
            pattern=tuple(self._pattern.rows()),
            crop=self._crop,
            pair_ratio=ratio,
            gains=gains,
            analyzers=None if analyzers is None else analyzers.record(),
            white_balance=white,
            scale=1.0 / max(1.0, peak),
            rounding=tuple(rounding),
            defects=standing_out,
            notes=notes,
        )

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

    def develop(self, view: str, measured: MosaicMeasured) -> DevelopedView:
        """Read one mosaic: validity, levels, gains, then demosaicing, then the sense of the angles."""
        path = self._files[view]
        stored = self._mosaics.read(path)
        dark = self._mosaics.dark(stored.shape)
        values = self._mosaics.cut(stored)
        levels = measured.levels
        saturated, black = unusable_samples(values, levels, dark)
        linear, (bad,) = self._mosaics.linear(values, levels, dark, saturated | black | self._defects(levels))
        linear = linear * self._mosaics.sample_factors(
            values.shape, measured.gains, measured.white_balance, measured.scale
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
            record=ViewRecord(
                clipped_share=round(float(saturated.mean()), 6),
                dark_share=round(float(black.mean()), 6),
                invalid_share=round(float(picture.invalid.mean()), 6),
                geometry=Geometry(
                    (stored.shape[1], stored.shape[0]),
                    self._crop,
                    DEMOSAIC_MODES[settings.demosaic],
                    (width, height),
                ),
            ),
            mask=None if self._dataset is None else resized_mask(self._dataset, view, (height, width)),
        )
