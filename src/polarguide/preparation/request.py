"""The request of a preparation: its settings, and its files, which are known by their content.

Times and paths change where files are copied, synchronized or moved; what is developed of them stays the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.records import read_record
from polarguide.core.text import canonical

_PARTS = ("file", "model")
_PATHS = ("dark_frame", "analyzers", "angles", "poses", "masks")
"""Settings that may be paths; the files there are among those of the request."""
_SOMEWHERE = "of a path"
_BLOCK = 1 << 20


class FileStamp(msgspec.Struct, frozen=True, array_like=True):
    """Identity of a file.

    Attributes:
        size: bytes. time: of its last change (ns); one that is unchanged is not read again.
        digest: SHA-256 of its content; empty in records of earlier versions.
    """

    size: int
    time: int
    digest: str = ""


class _Files(msgspec.Struct):
    file: dict[str, FileStamp] = {}
    model: dict[str, FileStamp] = {}


class _State(msgspec.Struct):
    request: _Files


class _Known(msgspec.Struct):
    prepare: _State


def request_of(
    root: Path,
    earlier: Iterable[Path],
    kind: str,
    settings: dict[str, Any],
    paths: Iterable[Path],
    model: Iterable[Path],
) -> dict[str, Any]:
    """Values that must not change between the calls that write one scene.

    Args:
        root: folder of the capture. earlier: records of earlier calls, whose digests of unchanged files are taken.
        kind: format. settings: as JSON.
        paths: files that are read; those that do not exist are passed over. model: files of the poses.
    """
    known = _Files()
    for record in earlier:
        with contextlib.suppress(PolarguideError):  # ``SceneFolder`` says what is wrong with it
            known = read_record(record, _Known).prepare.request
            break
    files = {_name(path, root): path for path in paths if path.exists()}
    request: dict[str, Any] = {
        "source": os.path.realpath(root),
        "format": kind,
        "settings": settings,
        "file": _stamps(files, known.file),
    }
    of_poses = _stamps({canonical(path.name): path for path in model}, known.model)
    return {**request, "model": of_poses} if of_poses else request


def _name(path: Path, root: Path) -> str:
    """A file's name in the folder of the capture; of one elsewhere, its name alone."""
    for folder in (root, Path(os.path.realpath(root))):
        if path.is_relative_to(folder):
            return canonical(path.relative_to(folder).as_posix())
    return canonical(f"../{path.name}")


def _stamps(files: Mapping[str, Path], known: Mapping[str, FileStamp]) -> dict[str, Any]:
    stamps = {}
    for name, path in files.items():
        status = path.stat()
        before = known.get(name)
        size = status.st_size
        time = status.st_mtime_ns
        unchanged = before is not None and before.digest and (before.size, before.time) == (size, time)
        digest = before.digest if before is not None and unchanged else _digest(path)
        stamps[name] = msgspec.to_builtins(FileStamp(size, time, digest))
    return stamps


def _digest(path: Path) -> str:
    """SHA-256 of a file; "" of a pipe, a device and an unreadable file, which its reader refuses."""
    digest = hashlib.sha256()
    if not path.is_file():
        return ""
    try:
        with open(path, "rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    except OSError:
        return ""
    return digest.hexdigest()


def first_difference(before: dict[str, Any], now: dict[str, Any]) -> tuple[str, str, str] | None:
    """Name, old and new value of the first thing that differs between two requests; None for equal ones."""
    old = _compared(before)
    new = _compared(now)
    for part in _PARTS:
        old_part = old.get(part, {})
        new_part = new.get(part, {})
        if any(not digest for _, _, digest in _stamps_of(old_part)):
            old[part], new[part] = _by_time(old_part), _by_time(new_part)
        else:
            old[part], new[part] = _by_content(old_part), _by_content(new_part)
    for part in sorted(old.keys() | new.keys()):
        if old.get(part) == new.get(part):
            continue
        if part not in (*_PARTS, "settings"):
            return part, str(old.get(part)), str(new.get(part))
        of_old = old[part]
        of_new = new[part]
        keys = sorted(of_old.keys() | of_new.keys())
        key = next(k for k in keys if (k in of_old) != (k in of_new) or of_old[k] != of_new[k])
        if part == "settings":
            return key, str(before[part].get(key)), str(now[part].get(key))
        happened = "removed" if key not in of_new else "changed" if key in of_old else "added"
        return f"{part} {key}", "as it was", f"that was {happened}"
    return None


def _compared(request: dict[str, Any]) -> dict[str, Any]:
    """A request without the places of files."""
    settings = {
        name: _SOMEWHERE if name in _PATHS and isinstance(value, str) and os.path.isabs(value) else value
        for name, value in request["settings"].items()
    }
    return {**{name: value for name, value in request.items() if name != "source"}, "settings": settings}


def _stamps_of(files: Mapping[str, Any]) -> list[tuple[int, int, str]]:
    stamps = [msgspec.convert(entry, FileStamp) for entry in files.values()]
    return [(stamp.size, stamp.time, stamp.digest) for stamp in stamps]


def _by_content(files: Mapping[str, Any]) -> dict[str, Any]:
    return {name: (size, digest) for name, (size, _, digest) in zip(files, _stamps_of(files), strict=True)}


def _by_time(files: Mapping[str, Any]) -> dict[str, Any]:
    """Sizes and times by the names of files, for records of earlier versions, which have no digests."""
    named: dict[str, list[tuple[int, int]]] = {}
    for name, (size, time, _) in zip(files, _stamps_of(files), strict=True):
        named.setdefault(canonical(PurePath(name).name), []).append((size, time))
    return {name: sorted(stamps) for name, stamps in named.items()}
