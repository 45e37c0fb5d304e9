"""``checksums.txt`` of a rendered scene: SHA-256 of all its files, in the format of ``sha256sum -c``.

The list leaves out ``scene.json``, which holds the digest of the list: one digest for the whole scene.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from polarguide.errors import PolarguideError
from polarguide.files import read_file
from polarguide.records import read_record
from polarguide.synth.folder import write_file

MANIFEST = "checksums.txt"
_REMEDY = "Remove the folder to render the scene again, or give another --out."
_FOLDERS = ("gt", "mesh", "polar", "raw", "sparse")
_FILES = ("calibration.json", "environment.hdr", "request.json", "sheet.jpg", "split.json")


def write_manifest(out: Path) -> str:
    """Write the list of a scene that is complete except ``scene.json``; returns the SHA-256 of the list."""
    lines = [f"{_digest(path)}  {path.relative_to(out).as_posix()}\n" for path in sorted(_written(out))]
    data = "".join(lines).encode()
    write_file(out / MANIFEST, data)
    return hashlib.sha256(data).hexdigest()


def verify_scene(out: Path) -> str:
    """Compare a finished scene with its list; returns the SHA-256 of the list.

    Raises:
        PolarguideError: a file is missing or has changed, or the list has.
    """
    data = read_file(out / MANIFEST, remedy=_REMEDY)
    if hashlib.sha256(data).hexdigest() != scene_digest(out):
        raise _changed(out / MANIFEST, "the list of checksums whose digest scene.json names")
    for line in data.decode(errors="replace").splitlines():
        expected, _, name = line.partition("  ")
        path = out / name
        if not path.resolve().is_relative_to(out.resolve()):
            raise _changed(out / MANIFEST, "a list of files of this scene")
        if not path.is_file() or _digest(path) != expected:
            raise _changed(path, f"the file that {MANIFEST} lists")
    return scene_digest(out)


def scene_digest(out: Path) -> str:
    """The digest in ``scene.json``, or an empty string."""
    return str(read_record(out / "scene.json", dict[str, Any], remedy=_REMEDY).get("sha256", ""))


def _written(out: Path) -> Iterator[Path]:
    """The files that rendering writes; others in the folder are the user's."""
    for name in _FOLDERS:
        yield from (path for path in (out / name).rglob("*") if path.is_file() and path.name[0] != ".")
    yield from (out / name for name in _FILES if (out / name).is_file())


def _digest(path: Path) -> str:
    return hashlib.sha256(read_file(path, remedy=_REMEDY)).hexdigest()


def _changed(path: Path, expected: str) -> PolarguideError:
    return PolarguideError(
        path,
        expected=expected,
        found="another" if path.is_file() else "no file",
        remedy=_REMEDY,
    )
