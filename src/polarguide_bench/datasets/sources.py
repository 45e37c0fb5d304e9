"""Sources of the pictures of published datasets, for ``prepare``."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Sense, oriented
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.formats.stored import stated_size
from polarguide.capture.layout import require_memory_of_each
from polarguide.capture.raw_options import CameraOptions, EncodedOptions
from polarguide.capture.sensor.pattern import Levels
from polarguide.core.errors import PolarguideWarning
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES, four_intensities
from polarguide.preparation.mosaic_source import MosaicMeasured, MosaicSource
from polarguide.preparation.settings import MosaicSettings
from polarguide.preparation.source import DevelopedView, Factor, Measured, Source, Stored, ViewRecord
from polarguide_bench.datasets.dataset import Dataset, not_as_published, resized_mask
from polarguide_bench.datasets.outlines import OutlineAgreement, outline_agreement, sense_of_outlines
from polarguide_bench.datasets.readers import open_dataset

PAIR_SUMS = (
    "n/a: the four intensities were made from Stokes vectors, so that I0 + I90 = I45 + I135 by construction"
)
"""Reason why the pair sums of Stokes vectors are not checked."""
_SENSE_NAMES: dict[Sense, str] = {"ccw": "counter-clockwise", "cw": "clockwise"}
_BRIGHT = 99.9
"""Percentile of the intensities that counts as bright, so that single highlights do not determine the scale."""
_HEADROOM = 2.0
"""Largest ratio of full scale to the bright intensity."""
_SAMPLES = 20_000
"""Largest number of pixels of a view from which the percentile is computed."""
# Smallest memory in bytes per pixel: Stokes vectors with and without invalid values, intensities, and clipped ones.
_WORKED = 4 * 3 * (3 + 3 + 4 + 4)


class StokesMeasured(Measured, kw_only=True):
    """Measurements that all Stokes vectors of a capture share.

    Attributes:
        scale: factor of the dataset's intensities.
        full_scale: intensity of the dataset that becomes 1.
        negative_share: share of negative intensities.
        not_finite_share: share of pixels that are not finite.
        pair_sums: comparison of I0 + I90 with I45 + I135.
        sense: direction in which the angles increase.
    """

    scale: Factor
    full_scale: float = 0.0
    negative_share: float = 0.0
    not_finite_share: float = 0.0
    pair_sums: str = PAIR_SUMS
    sense: Sense


class StokesSource(Source):
    """Source of a dataset that contains Stokes vectors in any unit, without a stated full scale."""

    measured_type = StokesMeasured

    def __init__(self, dataset: Dataset, settings: CameraOptions) -> None:
        """Use a dataset that has ``read_stokes``. By default, the angles increase in the direction that it states."""
        self.kind = dataset.name
        self.cameras = dataset.cameras
        self.views = dataset.views
        self.paths = dataset.paths
        self._dataset = dataset
        calibration = settings.calibration
        self._given_sense = calibration.sense
        self._calibration = replace(calibration, sense=calibration.sense or dataset.sense)

    def stored(self, view: str) -> Stored:
        """Return the size of a view, from the header of one of its files."""
        return Stored(stated_size(self._dataset.files[view]))

    def measure(self, advance: Advance) -> StokesMeasured:
        """Determine one scale for the whole capture, and the share of clipped pixels. Each file is read once.

        The largest intensity becomes 1 if it is at most twice the 99.9th percentile. Otherwise, twice this percentile
        becomes 1, and larger intensities clip.
        """
        require_memory_of_each(
            self.paths,
            _WORKED,
            "Stokes vectors",
            remedy="Reduce all files by the same factor, or prepare the dataset on a larger machine.",
        )
        peaks: list[NDArray[np.float32]] = []
        outlines: list[OutlineAgreement] = []
        largest = 0.0
        counts = np.zeros(3, np.int64)
        for number, view in enumerate(self.views, 1):
            stokes, finite, _ = self._stokes(view)
            intensities = np.stack(four_intensities(stokes))
            peak = intensities.max(axis=(0, 3))
            if view in self._dataset.masks and self._calibration.order == ANGLES:
                mask = resized_mask(self._dataset, view, peak.shape)
                assert mask is not None
                light = np.where(finite[..., None], stokes, np.nan)
                agreement = outline_agreement(light, mask, np.radians(self._calibration.zero))
                outlines += [] if agreement is None else [agreement]
            peaks.append(peak.ravel()[:: max(1, peak.size // _SAMPLES)])
            largest = max(largest, float(peak.max()))
            counts += (peak.size, (intensities < 0).sum(), (~finite).sum())
            advance(number)
        count, negative, broken = counts.tolist()
        bright = float(np.percentile(np.concatenate(peaks), _BRIGHT))
        if not largest > 0:
            raise not_as_published(
                self.paths[0], "light in at least one view", "intensities that are all 0 or less"
            )
        white = min(largest, _HEADROOM * bright) if bright > 0 else largest
        share = negative / max(1, 12 * count)
        sense, note = self._settle_sense(outlines)
        notes = [
            *self._dataset.notes,
            f"Four-angle sum check: {PAIR_SUMS}.",
            note,
            f"One scale for all views: {white:.6g} of the dataset becomes full scale. {share:.3%} of the intensities "
            "are negative because of noise or coarse files, and become 0.",
        ]
        if broken:
            notes.append(f"{broken / count:.3%} of the pixels are not finite and become invalid.")
        return StokesMeasured(
            scale=1.0 / (white * self._calibration.peak),
            full_scale=white,
            negative_share=round(share, 6),
            not_finite_share=round(broken / count, 6),
            sense=sense,
            notes=notes,
        )

    def develop(self, view: str, measured: StokesMeasured) -> DevelopedView:
        """Read and scale the Stokes vectors of a view, and compute its four intensities.

        The direction of the angles is corrected.
        """
        stokes, finite, clipped = self._stokes(view)
        intensities = np.stack(four_intensities(stokes * np.float32(measured.scale)))
        # Rounding of the scale can move the largest intensity slightly above 1.
        clipped = clipped | (intensities > 1.0 + 1e-5).any(axis=(0, 3))
        height, width = clipped.shape
        calibration = replace(self._calibration, sense=measured.sense)
        return DevelopedView(
            intensities=oriented(np.clip(intensities, 0.0, 1.0), calibration),
            invalid=clipped | ~finite,
            record=ViewRecord(
                clipped_share=round(float(clipped.mean()), 6),
                negative_share=round(float((intensities < 0).mean()), 6),
                invalid_share=round(float((clipped | ~finite).mean()), 6),
                geometry=Geometry((width, height), (0, 0), 1, (width, height)),
            ),
            mask=resized_mask(self._dataset, view, (height, width)),
        )

    def _settle_sense(self, outlines: list[OutlineAgreement]) -> tuple[Sense, str]:
        """Return the direction in which the angles increase, and the reason. Warn if the direction is doubtful."""
        sense = self._calibration.sense or "ccw"
        light_sense = sense_of_outlines(outlines)
        stated = self._given_sense is not None or self._dataset.sense_known
        reason = "according to the release" if self._dataset.sense_known else "by assumption"
        if self._given_sense is not None:
            reason = "according to --sense"
        doubt = ""
        if light_sense is not None:
            ccw, cw = np.mean(outlines, axis=0)
            figures = f"agreement with the outlines of masks: {ccw:.2f} counter-clockwise, {cw:.2f} clockwise"
            if light_sense == sense:
                reason += f", and the light agrees ({figures})"
            elif stated:
                doubt = f"Angles count {_SENSE_NAMES[sense]} {reason}, but the light contradicts this ({figures})."
            else:
                sense = light_sense
                reason = f"according to the light at the outlines of masks ({figures})"
        elif not stated:
            doubt = (
                f"The sense of {self.kind}'s angles is uncertain, and outlines of masks do not decide it. "
                f"Assumed: {_SENSE_NAMES[sense]}."
            )
        if doubt:
            remedy = f"Check with polarguide inspect; --sense {'ccw' if sense == 'cw' else 'cw'} reverses it."
            warnings.warn(f"{doubt} {remedy}", PolarguideWarning, stacklevel=3)
        note = (
            f"Angles count {_SENSE_NAMES[sense]} as displayed, {reason} (--sense and --zero override this)."
        )
        return sense, note

    def _stokes(self, view: str) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
        """Read the Stokes vectors of a view.

        Returns:
            Stokes vectors [3, H, W, 3] with 0 for invalid values; mask [H, W] of finite pixels; and mask of clipped
            pixels.
        """
        assert self._dataset.read_stokes is not None
        stokes, clipped = self._dataset.read_stokes(view)
        finite = np.asarray(np.isfinite(stokes).all(axis=(0, 3)))
        return np.where(finite[..., None], stokes, 0), finite, clipped


PISR_SENSOR: Final = "IMX250MYR"
"""Color sensor of the camera of PISR."""


class PisrSource(MosaicSource):
    """Source of the raw mosaics of PISR, with the cameras and masks of the dataset."""

    def __init__(self, dataset: Dataset, mosaics: Path, settings: MosaicSettings) -> None:
        """Use the mosaics in a folder of the dataset. Settings that the user did not specify are those of the release.

        Raises:
            PolarguideError: a setting does not fit the sensor.
        """
        release = replace(
            settings,
            sensor=settings.sensor or PISR_SENSOR,
            gamma=dataset.gamma,
            calibration=replace(settings.calibration, sense=settings.calibration.sense or dataset.sense),
        )
        super().__init__(mosaics, release, dataset.views)
        self.kind = dataset.name
        self.cameras = dataset.cameras
        calibrations = (settings.dark_frame, settings.analyzers)
        self.paths = [*dataset.paths, *(path for path in calibrations if path is not None)]
        self._dataset = dataset

    @property
    def description(self) -> str:
        """Numbers of views and of mosaics."""
        return f"{len(self.views)} views of the dataset {self.kind}, {super().description}"

    def check_sensor(self, blocks: NDArray[Any], levels: Levels) -> None:
        """Accept all mosaics, because the dataset states its sensor."""

    def measure(self, advance: Advance) -> MosaicMeasured:
        """Measure levels and gains of the angles, and add the notes of the dataset."""
        measured = super().measure(advance)
        measured.notes = [*self._dataset.notes, *measured.notes]
        return measured

    def develop(self, view: str, measured: MosaicMeasured) -> DevelopedView:
        """Develop one mosaic, and add the mask of the dataset."""
        developed = super().develop(view, measured)
        return replace(developed, mask=resized_mask(self._dataset, view, developed.invalid.shape))


def dataset_source(root: Path, name: str, options: CameraOptions) -> Source:
    """Open the pictures of a dataset.

    Args:
        root: folder of the dataset.
        name: name of the dataset, a key of ``READERS``.
        options: options of its format, see ``settings_of_format``.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    transfer = options.transfer if isinstance(options, EncodedOptions) else "auto"
    dataset = open_dataset(root, name, transfer=transfer)
    if dataset.mosaics is not None and isinstance(options, MosaicSettings):
        return PisrSource(dataset, dataset.mosaics, options)
    return StokesSource(dataset, options)
