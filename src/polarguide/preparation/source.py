"""Interface of picture sources, the sources for Stokes vectors and for raw mosaics, and the record of a preparation.

The record is ``prepare.json`` while the preparation runs, and becomes part of ``scene.json``. It identifies files by
their content, because copies, synchronization and moves change times and paths.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Generic, Protocol, TypeVar

import cv2
import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray

from polarguide.capture.angle_evidence import OutlineAgreement, outline_agreement, sense_of_outlines
from polarguide.capture.brackets import Bracket, MergedExposures, Radiance, bracket_notes
from polarguide.capture.calibration import (
    INVERSE,
    QUARTER_TURNS,
    UNIDENTIFIED,
    Sense,
    apply_orientation,
    oriented,
)
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.datasets.dataset import Dataset, not_as_published, read_mask, resized_mask
from polarguide.capture.develop import levels_of_capture, pair_gains
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.camera_files import Lens
from polarguide.capture.formats.stored import stated_size
from polarguide.capture.layout import all_exposures, exposure_tables, index_shot_files, require_memory_of_each
from polarguide.capture.raw_options import CameraOptions
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic
from polarguide.capture.sensor.mosaics import QUARTER_FLIPS, RAW_SUFFIXES, MosaicFiles, sample_blocks
from polarguide.capture.sensor.pattern import FULL_16, SIDE, Levels, agreed_full_scale, require_kind
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import EXACT, rounding_of
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.progress import Advance
from polarguide.core.text import canonical
from polarguide.geometry.polarizer import ANGLES, four_intensities
from polarguide.preparation.settings import MosaicSettings

Factor = Annotated[float, Meta(gt=0, le=1e12)]
"""Positive factor."""
_Code = Annotated[int, Meta(ge=0, le=FULL_CODE)]
_Multiple = tuple[_Code, Annotated[int, Meta(ge=1, le=FULL_CODE)]]
StoredRounding = Annotated[tuple[_Multiple, ...], Meta(min_length=1)]


class Measured(msgspec.Struct, kw_only=True):
    """Measurements that all views of a capture share.

    Attributes:
        notes: messages for the user.
        photographs: sizes and orientations of the pictures that structure from motion reads, by view.
        bracketed: True if several exposures of a shot were merged. All views are then stored as floating-point numbers.
    """

    notes: list[str] = []
    bracketed: bool = False
    photographs: dict[str, Geometry] | UnsetType = UNSET


class ExposureRecord(msgspec.Struct):
    """Record of one shot of a view.

    Attributes:
        source: name of the file in the capture.
        angle: angle of the polarizer as displayed.
        light: exposure that the file states.
        given_gain: gain that the user stated.
        gain: gain relative to the remaining shots.
        points: number of points by which it was compared.
    """

    source: str
    angle: Angle
    light: Factor | None
    given_gain: Factor | None
    gain: float | UnsetType = UNSET
    points: int | UnsetType = UNSET


class WarpRecord(msgspec.Struct):
    """Lens distortion that was removed from a view: COLMAP's camera model and its parameters."""

    model: str
    parameters: list[float]


class ViewRecord(msgspec.Struct, kw_only=True):
    """Record of a developed view. Fields that the kind of source does not measure are unset."""

    orientation: int | UnsetType = UNSET
    shifts: list[tuple[float, float]] | UnsetType = UNSET
    warps: list[tuple[float, ...] | None] | UnsetType = UNSET
    shifts_corrected: list[bool] | UnsetType = UNSET
    pair_ratio: float | UnsetType | None = UNSET
    light: list[float] | UnsetType = UNSET
    gains: list[float] | UnsetType = UNSET
    exposures: list[ExposureRecord] | UnsetType = UNSET
    clipped_share: float
    dark_share: float | UnsetType = UNSET
    negative_share: float | UnsetType = UNSET
    invalid_share: float | UnsetType = UNSET
    stops: list[float] | UnsetType = UNSET
    geometry: Geometry
    warp: WarpRecord | None = None
    files: dict[str, int] = {}

    @property
    def turned(self) -> bool:
        """True if the view was rotated for display."""
        return self.orientation not in (UNSET, 1)


def stops_record(exposures: MergedExposures) -> list[float] | UnsetType:
    """Return the merged exposures of a view in stops. Return ``UNSET`` for one exposure."""
    return [round(stop, 4) for stop in exposures.stops] if len(exposures.stops) > 1 else UNSET


class Request(msgspec.Struct, omit_defaults=True):
    """Inputs of a preparation, which must stay equal when the preparation is resumed.

    Attributes:
        source: folder of the capture.
        format: format of the capture.
        settings: settings as JSON.
        file: SHA-256 of the content of each file that is read, by name.
    """

    source: str
    format: str
    settings: dict[str, Any]
    file: dict[str, str]


M = TypeVar("M")


class State(msgspec.Struct, Generic[M]):
    """Progress of a preparation: its request, its measurements, and the views that it has written."""

    request: Request
    measured: M | None = None
    views: dict[str, ViewRecord] = {}


class Journal(msgspec.Struct, Generic[M]):
    """Part of ``prepare.json`` and ``scene.json`` that a resumed preparation reads."""

    prepare: State[M]


_BLOCK = 1 << 20
_PATHS = ("dark_frame", "analyzers", "angles", "poses", "masks")
"""Names of settings that may be paths. These files are listed in the request."""


def request_of(root: Path, kind: str, settings: dict[str, Any], paths: Iterable[Path]) -> Request:
    """Return the request of a call.

    Args:
        root: folder of the capture.
        kind: format of the capture.
        settings: settings as JSON.
        paths: files that are read; missing files are skipped.
    """
    roots = (root, Path(os.path.realpath(root)))
    files = {}
    for path in paths:
        if path.exists():
            folder = next((folder for folder in roots if path.is_relative_to(folder)), None)
            name = f"../{path.name}" if folder is None else path.relative_to(folder).as_posix()
            files[canonical(name)] = _digest(path)
    return Request(os.path.realpath(root), kind, settings, files)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file.

    Return an empty string for a pipe, a device or an unreadable file. Reading such a file fails later with an error.
    """
    digest = hashlib.sha256()
    if not path.is_file():
        return ""
    try:
        with open(path, "rb") as file:
            for block in iter(partial(file.read, _BLOCK), b""):
                digest.update(block)
    except OSError:
        return ""
    return digest.hexdigest()


def changed_entry(before: Request, now: Request) -> tuple[str, str, str] | None:
    """Return the first difference between two requests: its name, the old value and the new value.

    Return None if the requests are equal. Locations of files are not compared.
    """
    if before.format != now.format:
        return "format", before.format, now.format
    for key in sorted(before.settings.keys() | now.settings.keys()):
        values = [settings.get(key) for settings in (before.settings, now.settings)]
        paths = [key in _PATHS and isinstance(value, str) and os.path.isabs(value) for value in values]
        if values[0] != values[1] and not all(paths):
            return key, str(values[0]), str(values[1])
    for key in sorted(before.file.keys() | now.file.keys()):
        if before.file.get(key) != now.file.get(key):
            change = "removed" if key not in now.file else "changed" if key in before.file else "added"
            return f"file {key}", "as it was", f"that was {change}"
    return None


@dataclass(frozen=True, eq=False)
class DevelopedView:
    """Developed pictures of one view.

    Attributes:
        intensities: [4, H, W, 3] float32, linear, at 0, 45, 90 and 135 degrees. For other angles [K, H, W, 3]. Values
            are in [0, 1], and may be larger if the capture has brackets.
        invalid: mask [H, W] of pixels that depend on an unusable sample.
        mask: object mask [H, W], or None.
        angles: angles of the pictures, counter-clockwise as displayed.
        record: record of the view, including its ``geometry``.
        notes: messages for the user.
    """

    intensities: NDArray[np.float32]
    invalid: NDArray[np.bool_]
    record: ViewRecord
    notes: tuple[str, ...] = ()
    mask: NDArray[np.bool_] | None = None
    angles: Sequence[Angle] = ANGLES


@dataclass(frozen=True)
class Stored:
    """Size and orientation of a view's pictures as stored.

    Attributes:
        size: width and height of the stored pixels. None if no header states them.
        orientation: EXIF orientation, 1 to 8. 1 means no rotation.
        developed: width and height of the developed picture if it is smaller, else None.
    """

    size: tuple[int, int] | None
    orientation: int = 1
    developed: tuple[int, int] | None = None

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """Sizes that the camera of a view may have: stored, rotated and developed."""
        if self.size is None:
            return ()
        turned = (self.size[::-1],) if self.orientation in QUARTER_TURNS else ()
        return (self.size, *turned, *(() if self.developed is None else (self.developed,)))


class Source(Protocol):
    """Base class for the pictures of one capture.

    Attributes:
        kind: name of the format.
        cameras: cameras by view name. None for a source without poses.
        views: view names, sorted.
        paths: all files that are read except masks.
        masks: object masks of the user by view. Values of at least half of the maximum mark the object.
        as_stored: views that are developed without rotation, regardless of their orientation tags.
        measured_type: type of the result of ``measure``.
    """

    measured_type: type[Measured]
    kind: str
    cameras: Mapping[str, PosedCamera] | None
    views: list[str]
    paths: list[Path]
    masks: Mapping[str, Path] = MappingProxyType({})
    as_stored: frozenset[str] = frozenset()

    @property
    def description(self) -> str:
        """Number of views and their kind, for the user."""
        return f"{len(self.views)} views of the dataset {self.kind}"

    def measure(self, advance: Advance) -> Measured:
        """Measure the properties that all views of the capture share."""

    def develop(self, view: str, measured: Any) -> DevelopedView:
        """Read and develop one view."""

    def stored(self, view: str) -> Stored:
        """Return size and orientation of a view's pictures as stored, from the header of its first file."""

    def lenses(self) -> dict[str, Lens]:
        """Return the lens of each view if the files state different lenses, else an empty dictionary."""
        return {}


def develop_view(pictures: Source, view: str, measured: Measured) -> DevelopedView:
    """Develop a view with ``Source.develop``, and add its mask.

    Raises:
        PolarguideError: the mask cannot be read. Or its size differs from both the stored and the developed picture.
    """
    done = pictures.develop(view, measured)
    if view not in pictures.masks:
        return done
    code = pictures.stored(view).orientation
    code = INVERSE[code] if view in pictures.as_stored else code
    return replace(done, mask=_fit_mask(pictures.masks[view], done, code))


def _fit_mask(path: Path, view: DevelopedView, code: int) -> NDArray[np.bool_]:
    """Return a mask at the size of the developed picture. A pixel is True if at least half of it shows the object.

    If the mask has exchanged width and height, it is rotated like the picture.

    Args:
        path: file of the mask.
        view: the developed picture.
        code: EXIF orientation that rotates a mask with exchanged width and height to the picture.
    """
    mask = read_mask(path)
    geometry = view.record.geometry
    width, height = geometry.size
    sizes = (geometry.size, geometry.stored)
    if code in QUARTER_TURNS and mask.shape[::-1] not in sizes and mask.shape in sizes:
        mask = apply_orientation(mask, code)
    if mask.shape == (height, width):
        return mask
    if mask.shape[::-1] != geometry.stored:
        stored = geometry.stored
        raise PolarguideError(
            path,
            expected=f"the size of the picture, {width}x{height}, or of the file, {stored[0]}x{stored[1]}",
            found=f"{mask.shape[1]}x{mask.shape[0]}",
            remedy="Make the mask at one of these sizes.",
        )
    left, top = geometry.crop
    step = geometry.step
    cut = mask[top : top + height * step, left : left + width * step].astype(np.float32)
    return np.asarray(cv2.resize(cut, geometry.size, interpolation=cv2.INTER_AREA) >= 0.5)


PAIR_SUMS = (
    "n/a: the four intensities were made from Stokes vectors, so that I0 + I90 = I45 + I135 by construction"
)
_SENSE_NAMES: dict[Sense, str] = {"ccw": "counter-clockwise", "cw": "clockwise"}
_BRIGHT = 99.9
_HEADROOM = 2.0
_SAMPLES = 20_000
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

    def __init__(self, root: Path, settings: MosaicSettings, dataset: Dataset | None = None) -> None:
        """Find the mosaics of a folder.

        Args:
            root: the folder of mosaics.
            settings: settings of the preparation.
            dataset: the published dataset of the mosaics, or None.

        Raises:
            PolarguideError: the sensor is missing, or a setting does not fit it.
        """
        self.kind = "mosaic" if dataset is None else dataset.name
        self.cameras = None if dataset is None else dataset.cameras
        self._dataset = dataset
        self._mosaics = MosaicFiles(settings)
        self._settings = settings
        files = index_shot_files(root, RAW_SUFFIXES)
        if settings.dark_frame is not None:
            dark = os.path.realpath(settings.dark_frame)
            files = {view: path for view, path in files.items() if os.path.realpath(path) != dark}
        names = files.keys() if dataset is None else dataset.views
        self._files = {view: files[view] for view in sorted(names)}
        self.views = list(self._files)
        self._brackets = {view: Bracket.of([path]) for view, path in self._files.items()}
        represented = list(self._files.values())
        self.paths = (
            [*all_exposures(represented), *exposure_tables(represented)]
            if dataset is None
            else list(dataset.paths)
        )
        self.paths += [path for path in (settings.dark_frame, settings.analyzers) if path is not None]
        self._defective: NDArray[np.bool_] | None = None

    @property
    def description(self) -> str:
        """Number of mosaics."""
        mosaics = f"{len(self.views)} raw mosaics of a polarization camera"
        return mosaics if self._dataset is None else f"{super().description}, {mosaics}"

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
        levels = replace(levels, gamma=settings.gamma if self._dataset is None else self._dataset.gamma)
        if self._dataset is None:
            assert settings.sensor is not None
            require_kind(settings.sensor, np.concatenate(blocks), levels)
        ratio = self._mosaics.ratio_of_blocks(samples, levels, self._mosaics.dark(shape[0]), cut.shape)
        analyzers = self._mosaics.analyzers
        gains, notes = pair_gains(
            ratio,
            settings,
            _GAINS if settings.gains == "auto" else {},
            calibrated=analyzers is not None,
        )
        notes += [] if self._dataset is None else self._dataset.notes
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
            mask=None if self._dataset is None else resized_mask(self._dataset, view, (height, width)),
        )
