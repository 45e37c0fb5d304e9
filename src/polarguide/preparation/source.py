"""The interface of picture sources, with object masks of the user, and of Stokes vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import oriented
from polarguide.capture.colmap.files import PosedCamera
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.datasets.dataset import Dataset, not_as_published, resized_mask
from polarguide.capture.exposures import Angle
from polarguide.capture.formats.pictures import SUFFIXES, decode_mask, read_picture
from polarguide.capture.memory import require_memory_of_each
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES, four_intensities
from polarguide.preparation.settings import PrepareSettings


@dataclass(frozen=True, eq=False)
class DevelopedView:
    """The developed picture of one view.

    Attributes:
        intensities: [4, H, W, 3] float32 in [0, 1], linear, at 0, 45, 90 and 135 degrees; or [K, H, W, 3].
        invalid: pixels that depend on an unusable sample, [H, W].
        geometry: crop and scale relative to the stored picture.
        mask: object mask, [H, W], or None.
        angles: of the pictures, counter-clockwise as displayed.
        record: measurements for ``scene.json``.
        notes: messages for the user.
    """

    intensities: NDArray[np.float32]
    invalid: NDArray[np.bool_]
    geometry: Geometry
    record: dict[str, Any]
    notes: tuple[str, ...] = ()
    mask: NDArray[np.bool_] | None = None
    angles: Sequence[Angle] = ANGLES


class Source(Protocol):
    """The pictures of one capture.

    Attributes:
        kind: name of the format.
        cameras: by view name, if the source has poses, else None.
        views: view names, sorted.
        paths: all files that are read.
        needs: keys of what ``measure`` returns that ``develop`` reads.
    """

    needs: tuple[str, ...]
    kind: str
    cameras: Mapping[str, PosedCamera] | None
    views: list[str]
    paths: list[Path]

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Measure what is common to the whole capture, as JSON types; ``notes`` are messages for the user."""

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one view."""


class MaskedSource(Source):
    """A source with object masks from a folder; the object is where a mask has at least half of its maximum."""

    def __init__(self, pictures: Source, folder: Path) -> None:
        """Find the masks, named like the views.

        Args:
            pictures: the source without them.
            folder: with one picture for each view that has a mask.

        Raises:
            PolarguideError: there is no such folder, or none of its pictures is named like a view.
        """
        if not folder.is_dir():
            raise PolarguideError(
                "--masks",
                expected="a folder of masks named like the views",
                found=f"{folder}, which is not a folder",
                remedy="Give the folder that holds <view>.png.",
            )
        found = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in SUFFIXES}
        self._masks = {view: found[view] for view in pictures.views if view in found}
        if not self._masks:
            raise PolarguideError(
                folder,
                expected=f"masks named like the views ({listed(pictures.views, 3)})",
                found=listed(sorted(found), 3) or "no picture",
                remedy="Rename them; views without a mask are used whole.",
            )
        self._pictures = pictures
        self.needs = pictures.needs
        self.kind, self.cameras, self.views = pictures.kind, pictures.cameras, pictures.views
        self.paths = [*pictures.paths, *self._masks.values()]

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Measure the source, and note views without a mask."""
        measured = self._pictures.measure(advance)
        bare = [view for view in self.views if view not in self._masks]
        if bare:
            note = f"{len(bare)} of {len(self.views)} views have no mask and are used whole ({listed(bare)})."
            measured["notes"] = [*measured["notes"], note]
        return measured

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one view, with its mask.

        Raises:
            PolarguideError: the mask cannot be read, or is neither of the stored nor the developed size.
        """
        done = self._pictures.develop(view, measured)
        path = self._masks.get(view)
        return done if path is None else replace(done, mask=_fitted(path, done))


def _fitted(path: Path, view: DevelopedView) -> NDArray[np.bool_]:
    """A mask at the size of the developed picture: True where at least half of a pixel is object."""
    mask = decode_mask(path, read_picture(path), any_value=False)
    geometry = view.geometry
    size = (mask.shape[1], mask.shape[0])
    if size == geometry.size:
        return mask
    if size != geometry.stored:
        (width, height), stored = geometry.size, geometry.stored
        raise PolarguideError(
            path,
            expected=f"the size of the picture, {width}x{height}, or of the file, {stored[0]}x{stored[1]}",
            found=f"{size[0]}x{size[1]}",
            remedy="Make the mask at one of these sizes.",
        )
    (left, top), (width, height), step = geometry.crop, geometry.size, geometry.step
    cut = mask[top : top + height * step, left : left + width * step].astype(np.float32)
    return np.asarray(cv2.resize(cut, geometry.size, interpolation=cv2.INTER_AREA) >= 0.5)


PAIR_SUMS = (
    "n/a: the four intensities were made from Stokes vectors, so that I0 + I90 = I45 + I135 by construction"
)
_BRIGHT = 99.9
_HEADROOM = 2.0
_SAMPLES = 20_000
# Bytes that a pixel takes at least: Stokes vectors as read and where they are finite, intensities, clipped ones.
_WORKED = 4 * 3 * (3 + 3 + 4 + 4)


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
            stokes, finite, _ = self._stokes(view)
            intensities = np.stack(four_intensities(stokes))
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
        stokes, finite, clipped = self._stokes(view)
        intensities = np.stack(four_intensities(stokes * np.float32(measured["scale"])))
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

    def _stokes(self, view: str) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
        """Stokes vectors [3, H, W, 3], 0 where they are not finite; where they are, and where they clipped, [H, W]."""
        assert self._dataset.read_stokes is not None
        stokes, clipped = self._dataset.read_stokes(view)
        finite = np.asarray(np.isfinite(stokes).all(axis=(0, 3)))
        return np.where(finite[..., None], stokes, 0), finite, clipped
