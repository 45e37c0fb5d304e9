"""Record of a preparation. It is ``prepare.json`` while the preparation runs, and becomes part of ``scene.json``.

Files are identified by their content, because copies, synchronization and moves change times and paths.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path, PurePath
from typing import Annotated, Any, Generic, TypeVar

import msgspec
from msgspec import UNSET, Meta, UnsetType

from polarguide.capture.brackets import MergedExposures
from polarguide.capture.colmap.poses import Geometry
from polarguide.capture.exposures import Angle
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideError
from polarguide.core.records import read_record
from polarguide.core.text import canonical

Factor = Annotated[float, Meta(gt=0, le=1e12)]
"""Type of a positive factor."""
"""Positive factor."""
FourFactors = tuple[Factor, Factor, Factor, Factor]
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


class FileStamp(msgspec.Struct, frozen=True, array_like=True):
    """Identity of a file, to detect whether it has changed.

    Attributes:
        size: size in bytes.
        time: time of its last change in nanoseconds. If size and time are unchanged, the digest is not computed again.
        digest: SHA-256 of its content; empty in records of earlier versions.
    """

    size: int
    time: int
    digest: str = ""


class Request(msgspec.Struct, omit_defaults=True):
    """Inputs of a preparation, which must stay equal when the preparation is resumed.

    Attributes:
        source: folder of the capture.
        format: format of the capture.
        settings: settings as JSON.
        file: stamps of the files that are read, by name.
        model: stamps of the files of the poses.
    """

    source: str
    format: str
    settings: dict[str, Any]
    file: dict[str, FileStamp]
    model: dict[str, FileStamp] = {}


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


def request_of(
    root: Path,
    earlier: Iterable[Path],
    kind: str,
    settings: dict[str, Any],
    paths: Iterable[Path],
    model: Iterable[Path],
) -> Request:
    """Return the request of a call.

    Args:
        root: folder of the capture.
        earlier: records of earlier calls, which contain digests of unchanged files.
        kind: format of the capture.
        settings: settings as JSON.
        paths: files that are read; missing files are skipped.
        model: files of the poses.
    """
    known: Mapping[str, Mapping[str, FileStamp]] = {}
    for record in earlier:
        with contextlib.suppress(PolarguideError):  # ``SceneFolder`` reports it
            request = read_record(record, Journal[Any]).prepare.request
            known = {"file": request.file, "model": request.model}
            break
    files: dict[str, Path] = {}
    for path in paths:
        if path.exists():
            folders = (
                folder for folder in (root, Path(os.path.realpath(root))) if path.is_relative_to(folder)
            )
            folder = next(folders, None)
            name = f"../{path.name}" if folder is None else path.relative_to(folder).as_posix()
            files[canonical(name)] = path
    poses = {canonical(path.name): path for path in model}
    return Request(
        os.path.realpath(root),
        kind,
        settings,
        _stamps(files, known.get("file", {})),
        _stamps(poses, known.get("model", {})),
    )


def _stamps(files: Mapping[str, Path], known: Mapping[str, FileStamp]) -> dict[str, FileStamp]:
    stamps = {}
    for name, path in files.items():
        status = path.stat()
        stamp = FileStamp(status.st_size, status.st_mtime_ns)
        before = known.get(name, stamp)
        if not before.digest or (before.size, before.time) != (stamp.size, stamp.time):
            before = msgspec.structs.replace(stamp, digest=_digest(path))
        stamps[name] = before
    return stamps


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
    for part, files, now_files in (("file", before.file, now.file), ("model", before.model, now.model)):
        digests = all(stamp.digest for stamp in files.values())
        old, new = (_comparable(each, digests=digests) for each in (files, now_files))
        for key in sorted(old.keys() | new.keys()):
            if old.get(key) != new.get(key):
                change = "removed" if key not in new else "changed" if key in old else "added"
                return f"{part} {key}", "as it was", f"that was {change}"
    for key in sorted(before.settings.keys() | now.settings.keys()):
        values = [settings.get(key) for settings in (before.settings, now.settings)]
        paths = [key in _PATHS and isinstance(value, str) and os.path.isabs(value) for value in values]
        missing = (key in before.settings) != (key in now.settings)
        if missing or (values[0] != values[1] and not all(paths)):
            return key, str(values[0]), str(values[1])
    return None


def _comparable(files: Mapping[str, FileStamp], *, digests: bool) -> dict[str, Any]:
    """Return the sizes and digests of files, by name.

    Without digests, return sizes and times, by names without folders.
    """
    if digests:
        return {name: (stamp.size, stamp.digest) for name, stamp in files.items()}
    named: dict[str, Any] = {}
    for name, stamp in files.items():
        key = canonical(PurePath(name).name)
        named[key] = sorted([*named.get(key, ()), (stamp.size, stamp.time)])
    return named
