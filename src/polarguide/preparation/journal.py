"""Record of a preparation. It is ``prepare.json`` while the preparation runs, and becomes part of ``scene.json``.

Files are identified by their content, because copies, synchronization and moves change times and paths.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import msgspec
from msgspec import UNSET, Meta, UnsetType

from polarguide.capture.brackets import MergedExposures
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.exposures import Angle
from polarguide.capture.view import FULL_CODE
from polarguide.core.text import canonical

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
