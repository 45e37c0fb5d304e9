"""Interface of picture sources, and the record of a preparation.

The record is ``prepare.json`` while the preparation runs, and becomes part of ``scene.json``. It identifies files by
their content, because copies, synchronization and moves change times and paths.
"""

from __future__ import annotations

import hashlib
import os
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

from polarguide.capture.brackets import MergedExposures
from polarguide.capture.calibration import (
    INVERSE,
    QUARTER_TURNS,
    apply_orientation,
)
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.camera_files import Lens
from polarguide.capture.formats.pictures import read_mask
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.core.text import canonical
from polarguide.geometry.polarizer import ANGLES

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
    cameras: Mapping[str, PosedCamera] | None = None
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
