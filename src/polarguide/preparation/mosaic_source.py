"""Source of raw mosaics of a polarization camera."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.brackets import Bracket, Radiance, bracket_notes
from polarguide.capture.calibration import UNIDENTIFIED, oriented
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.develop import levels_of_capture, pair_gains
from polarguide.capture.formats.stored import stated_size
from polarguide.capture.layout import all_exposures, exposure_tables, index_shot_files
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic
from polarguide.capture.sensor.mosaics import QUARTER_FLIPS, RAW_SUFFIXES, MosaicFiles, sample_blocks
from polarguide.capture.sensor.pattern import FULL_16, SIDE, Levels, agreed_full_scale, require_kind
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import EXACT, rounding_of
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.preparation.settings import MosaicSettings
from polarguide.preparation.source import (
    DevelopedView,
    Factor,
    Measured,
    Source,
    Stored,
    StoredRounding,
    ViewRecord,
    stops_record,
)

_JUDGED = 8
"""Largest number of mosaics that are searched for defects of the sensor."""
_GAINS = {
    "dark": "The pictures are too dark to estimate the gains of the angles.",
    "off": "I0 + I90 differs from I45 + I135 by {:+.2%}, too much for gains. It is not corrected. Check --sensor, "
    "--offset-x, --offset-y and --order.",
    "corrected": f"I0 + I90 differed from I45 + I135 by {{:+.2%}} and is corrected. {UNIDENTIFIED}",
}


class MosaicMeasured(Measured, kw_only=True):
    """Measurements that all mosaics of a capture share.

    Attributes:
        levels: black level and full scale of the stored values.
        pattern: rows of the sensor's pattern.
        crop: numbers of columns and rows that are cut off.
        pair_ratio: ratio of I0 + I90 to I45 + I135.
        gains: gains of the four angles.
        analyzers: calibration of the sensor.
        scale: factor of the linear values.
        rounding: steps to which stored values are rounded.
        defects: number of defective samples.
    """

    levels: Levels
    pattern: tuple[str, ...] = ()
    crop: tuple[int, int] = (0, 0)
    pair_ratio: float | None = None
    gains: tuple[Factor, Factor, Factor, Factor]
    analyzers: dict[str, str] | None = None
    scale: Factor
    rounding: StoredRounding = tuple(EXACT)
    defects: int = 0


class MosaicSource(Source):
    """Source of raw mosaics of a polarization camera, whose pixels have polarizers at four angles."""

    measured_type = MosaicMeasured

    def __init__(self, root: Path, settings: MosaicSettings, views: Collection[str] | None = None) -> None:
        """Find the mosaics of a folder.

        Args:
            root: the folder of mosaics.
            settings: settings of the preparation.
            views: names of the views to use; None means all.

        Raises:
            PolarguideError: the sensor is missing, or a setting does not fit it.
        """
        self.kind = "mosaic"
        self._mosaics = MosaicFiles(settings)
        self._settings = settings
        files = index_shot_files(root, RAW_SUFFIXES)
        if settings.dark_frame is not None:
            dark = os.path.realpath(settings.dark_frame)
            files = {view: path for view, path in files.items() if os.path.realpath(path) != dark}
        self._files = {view: files[view] for view in sorted(files if views is None else views)}
        self.views = list(self._files)
        self._brackets = {view: Bracket.of([path]) for view, path in self._files.items()}
        represented = list(self._files.values())
        self.paths = [*all_exposures(represented), *exposure_tables(represented)]
        self.paths += [path for path in (settings.dark_frame, settings.analyzers) if path is not None]
        self._defective: NDArray[np.bool_] | None = None

    @property
    def description(self) -> str:
        """Number of mosaics."""
        return f"{len(self.views)} raw mosaics of a polarization camera"

    def stored(self, view: str) -> Stored:
        """Return the size of a view, from the header of its mosaic or from the settings."""
        settings = self._settings
        size = stated_size(self._files[view])
        if size is None and settings.width is not None and settings.height is not None:
            size = (settings.width, settings.height)
        if size is not None and settings.flip in QUARTER_FLIPS:
            size = size[::-1]
        step = DEMOSAIC_MODES[settings.demosaic]
        if size is None or step == 1:
            return Stored(size)
        across, down = (
            (side - cut) // 2 * 2 // step for side, cut in zip(size, self._mosaics.crop, strict=True)
        )
        return Stored(size, developed=(across, down))

    def measure(self, advance: Advance) -> MosaicMeasured:
        """Measure levels and gains of the angles of the capture. Each file is read once."""
        counts = np.zeros(FULL_16 + 1, np.int64)
        container = 0
        shape = None
        stated: dict[Path, int | None] = {}
        samples: list[NDArray[Any]] = []
        blocks: list[NDArray[Any]] = []
        for count, (view, first) in enumerate(self._files.items(), 1):
            for (path,) in self._brackets[view].files:
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
                if path == first:
                    cut = self._mosaics.cut(values)
                    samples.append(sample_blocks(cut, 2 * self._mosaics.pattern.period))
                    blocks.append(sample_blocks(cut, SIDE))
            advance(count)
        assert shape is not None
        settings = self._settings
        levels, counted = levels_of_capture(
            counts, container, settings, black=settings.black_level, stated=agreed_full_scale(stated)
        )
        levels = replace(levels, gamma=settings.gamma)
        self.check_sensor(np.concatenate(blocks), levels)
        ratio = self._mosaics.ratio_of_blocks(samples, levels, self._mosaics.dark(shape[0]), cut.shape)
        analyzers = self._mosaics.analyzers
        gains, notes = pair_gains(
            ratio,
            settings,
            _GAINS if settings.gains == "auto" else {},
            calibrated=analyzers is not None,
        )
        notes += counted
        defective = int(self._defects(levels).sum())
        if defective:
            notes.append(defects_note(defective, shape[0][0] * shape[0][1]))
        peak = settings.calibration.peak / min(gains)
        if analyzers is not None:
            peak *= analyzers.peak(self._mosaics.corner, cut.shape[::-1])
        rounding = EXACT
        if settings.precision == "source" and levels.gamma == 1.0:
            # The smallest factor of a sample.
            factor = 1.0 / max(gains) / max(1.0, peak)
            rounding = rounding_of(np.array([0.0, FULL_CODE * factor / ((1 << levels.bits) - 1)]))
        several = [view for view, bracket in self._brackets.items() if not bracket.single]
        merged = [self._merged(view, levels)[0].exposures for view in several]
        return MosaicMeasured(
            bracketed=bool(several),
            levels=levels,
            pattern=tuple(self._mosaics.pattern.rows()),
            crop=self._mosaics.crop,
            pair_ratio=ratio,
            gains=gains,
            analyzers=None if analyzers is None else analyzers.record(),
            scale=1.0 / max(1.0, peak),
            rounding=tuple(rounding),
            defects=defective,
            notes=[*notes, *bracket_notes(merged)],
        )

    def check_sensor(self, blocks: NDArray[Any], levels: Levels) -> None:
        """Refuse mosaics of a color sensor if the user specified a monochrome sensor, and the reverse.

        Args:
            blocks: stored values, see ``color_filters``.
            levels: levels of the stored values.

        Raises:
            PolarguideError: the samples contradict the sensor.
        """
        assert self._settings.sensor is not None
        require_kind(self._settings.sensor, blocks, levels)

    def _merged(self, view: str, levels: Levels) -> tuple[Radiance, NDArray[np.bool_], tuple[int, ...]]:
        """Read the exposures of a view and merge them.

        Returns:
            The merged samples; the mask of dark samples; and the numbers of rows and columns of the stored mosaic.

        Raises:
            PolarguideError: the exposures contradict each other.
        """
        bracket = self._brackets[view]
        stored = [self._mosaics.read(path) for (path,) in bracket.files]
        values = [self._mosaics.cut(each) for each in stored]
        shape = stored[0].shape
        radiance, black = self._mosaics.merged(bracket, values, levels, self._mosaics.dark(shape))
        return radiance, black, shape

    def _defects(self, levels: Levels) -> NDArray[np.bool_]:
        """Return a mask of defective samples.

        The mosaic is cropped to whole cells of the pattern. Saturated samples do not count as defects.
        """
        if self._defective is None:
            files = list(self._files.values())
            sample = files[:: max(1, math.ceil(len(files) / _JUDGED))]
            mosaics = (
                np.minimum(self._mosaics.cut(self._mosaics.read(path)), levels.white) for path in sample
            )
            self._defective = defects(mosaics, self._mosaics.pattern.period)
        return self._defective

    def develop(self, view: str, measured: MosaicMeasured) -> DevelopedView:
        """Develop one mosaic.

        The steps are: find invalid samples, correct levels and gains, demosaic, and correct the direction of the
        angles.
        """
        levels = measured.levels
        radiance, black, shape = self._merged(view, levels)
        saturated = radiance.clipped
        linear, (bad,) = self._mosaics.calibrated(radiance.values, saturated | black | self._defects(levels))
        linear = linear * self._mosaics.sample_factors(linear.shape, measured.gains, measured.scale)
        settings = self._settings
        picture = demosaic(
            linear, bad, self._mosaics.pattern,
            mode=settings.demosaic, registered=settings.register,
        )  # fmt: skip
        largest = None if measured.bracketed else 1.0
        intensities = oriented(np.clip(picture.intensities, 0.0, largest), settings.calibration)
        height, width = picture.invalid.shape
        return DevelopedView(
            intensities=intensities,
            invalid=picture.invalid,
            record=ViewRecord(
                clipped_share=round(float(saturated.mean()), 6),
                dark_share=round(float(black.mean()), 6),
                invalid_share=round(float(picture.invalid.mean()), 6),
                stops=stops_record(radiance.exposures),
                geometry=Geometry(
                    (shape[1], shape[0]),
                    self._mosaics.crop,
                    DEMOSAIC_MODES[settings.demosaic],
                    (width, height),
                ),
            ),
        )
