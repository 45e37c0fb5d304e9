"""Picture source: Stokes vectors of a published dataset, converted to four intensities."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import oriented
from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.datasets.dataset import Dataset, StokesImage, not_as_published, resized_mask
from polarguide.capture.memory import require_memory_of_each
from polarguide.polarizer import four_intensities
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.source import DevelopedView, Source
from polarguide.progress import Advance

PAIR_SUMS = (
    "n/a: the four intensities were made from Stokes vectors, so that I0 + I90 = I45 + I135 by construction"
)
_BRIGHT = 99.9
_HEADROOM = 2.0
_SAMPLES = 20_000
_WORKED = 4 * 3 * (3 + 3 + 4 + 4)
"""Bytes that a pixel takes at least: Stokes vectors as read and where they are finite, intensities, clipped ones."""


class StokesSource(Source):
    """Stokes vectors in any unit, without a full scale."""

    needs = ("scale",)

    def __init__(self, dataset: Dataset, settings: PrepareSettings) -> None:
        """Use a dataset with ``read_stokes``; its sense of angles applies unless the settings name one."""
        self.kind, self.cameras = dataset.name, dataset.cameras
        self.views, self.paths = dataset.views, dataset.paths
        self._dataset = dataset
        asked = settings.calibration
        self._calibration = replace(asked, sense=asked.sense or dataset.sense)

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Determine one scale for the whole capture, and the share of clipped pixels; every file is read once.

        The largest intensity becomes 1 where it is at most twice the one that 0.1 % of the pixels exceed;
        else twice this one does, and what exceeds it clips.
        """
        remedy = "Make the files smaller, all by the same factor, or prepare the dataset on a larger machine."
        require_memory_of_each(self.paths, _WORKED, "Stokes vectors", remedy=remedy)
        peaks: list[NDArray[np.float32]] = []
        largest, negative, broken, count = 0.0, 0, 0, 0
        for number, view in enumerate(self.views, 1):
            stokes, _ = self._stokes(view)
            finite = np.asarray(np.isfinite(stokes).all(axis=(0, 3)))
            intensities = np.stack(four_intensities(np.where(finite[..., None], stokes, 0)))
            peak = intensities.max(axis=(0, 3))
            peaks.append(peak.ravel()[:: max(1, peak.size // _SAMPLES)])
            largest = max(largest, float(peak.max()))
            negative += int((intensities < 0).sum())
            broken += int((~finite).sum())
            count += peak.size
            advance(number)
        bright = float(np.percentile(np.concatenate(peaks), _BRIGHT))
        if not largest > 0:
            found = "intensities that are all 0 or less"
            raise not_as_published(self.paths[0], "light in at least one view", found)
        white = min(largest, _HEADROOM * bright) if bright > 0 else largest
        share = negative / max(1, 12 * count)
        notes = [*self._dataset.notes, f"Four-angle sum check: {PAIR_SUMS}."]
        notes.append(
            f"Angles count {'clockwise' if self._calibration.sense == 'cw' else 'counter-clockwise'} as displayed "
            f"({self.kind}; --sense and --zero say otherwise)."
        )
        notes.append(
            f"One scale for all views: {white:.6g} of the dataset becomes full scale. {share:.3%} of the intensities "
            "are negative (more polarized than light can be: noise, or coarse files) and become 0."
        )
        if broken:
            notes.append(f"{broken / count:.3%} of the pixels are not finite and become invalid.")
        return {
            "scale": 1.0 / (white * self._calibration.peak),
            "full_scale": white,
            "negative_share": round(share, 6),
            "not_finite_share": round(broken / count, 6),
            "pair_sums": PAIR_SUMS,
            "sense": self._calibration.sense,
            "notes": notes,
        }

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one view, scale it, form the four intensities and correct the sense of the angles."""
        stokes, clipped = self._stokes(view)
        finite = np.asarray(np.isfinite(stokes).all(axis=(0, 3)))
        scaled = np.where(finite[..., None], stokes, 0) * np.float32(measured["scale"])
        intensities = np.stack(four_intensities(scaled))
        # Rounding of the scale may leave the largest intensity a hair above 1.
        clipped = clipped | (intensities > 1.0 + 1e-5).any(axis=(0, 3))
        height, width = clipped.shape
        rotated = oriented(np.clip(intensities, 0.0, 1.0), self._calibration)
        return DevelopedView(
            intensities=rotated,
            invalid=clipped | ~finite,
            geometry=Geometry((width, height), (0, 0), 1, (width, height)),
            record={
                "clipped_share": round(float(clipped.mean()), 6),
                "negative_share": round(float((intensities < 0).mean()), 6),
                "invalid_share": round(float((clipped | ~finite).mean()), 6),
            },
            mask=resized_mask(self._dataset, view, (height, width)),
        )

    def _stokes(self, view: str) -> StokesImage:
        assert self._dataset.read_stokes is not None
        return self._dataset.read_stokes(view)
