"""The table of a folder of shots on disk. No line is lost or repeated if the process is killed.

``table.jsonl`` has one line per shot, with all regions and files. It is both the table and the journal of measured
shots. A line is written at once and forced to disk before the next step. The next start removes an incomplete line, and
its shot is measured again.
``table.csv`` has one line per region. It is written after ``table.jsonl`` and recreated from it at every start.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import msgspec
from msgspec import Meta

from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import (
    atomic,
    check_out,
    make_folder,
    require_file,
    require_inside,
    write_whole,
    writing,
)
from polarguide.core.records import decode, first_differing_value, read_record, shortened, to_json
from polarguide.core.system import only_writer
from polarguide.core.text import csv_lines
from polarguide_shots.measurement.fields import FORMAT, KEYS, Status, Value

LINES = "table.jsonl"
CSV = "table.csv"
SETTINGS = "measure.json"
LOCK = ".lock"
_LAST = 2**63 - 1
"""Largest time in nanoseconds since 1970, 292 years. Some disks have later times."""
_REPLACE = "Give another --out, or --overwrite to replace this table."


class FileStamp(msgspec.Struct, frozen=True):
    """State of a file: path, size in bytes, and time of its last change in nanoseconds."""

    path: str
    bytes: int
    modified: Annotated[int, Meta(ge=-_LAST, le=_LAST)]


def stamps(paths: Sequence[Path]) -> tuple[FileStamp, ...]:
    """Return the current state of files.

    Raises:
        OSError: a file is missing.
    """
    states = ((os.path.abspath(path), os.stat(path)) for path in paths)
    return tuple(
        FileStamp(path, state.st_size, min(max(state.st_mtime_ns, -_LAST), _LAST)) for path, state in states
    )


class Entry(msgspec.Struct, frozen=True):
    """One line of ``table.jsonl``.

    Attributes:
        format: ``fields.FORMAT``.
        shot: name of the shot.
        files: files of the shot.
        status: worst status of the regions; "unread" for a shot that could not be read.
        why: reason of an unread shot, else empty.
        notes: assumptions about the shot.
        regions: figures of the regions by ``Field.key``, from ``region`` on.
        picture: name of the pictures without suffix; empty without pictures.
    """

    format: int
    shot: str
    files: tuple[FileStamp, ...]
    status: Status
    why: str
    notes: tuple[str, ...]
    regions: tuple[dict[str, Value], ...]
    picture: str = ""

    def line(self) -> bytes:
        """Return the line of ``table.jsonl``. Escapes of JSON keep names that are not valid Unicode."""
        return json.dumps(msgspec.to_builtins(self)).encode() + b"\n"

    def rows(self) -> Iterator[list[Value]]:
        """Return the lines of the CSV table."""
        taken = ""
        if self.files:
            newest = datetime.fromtimestamp(max(file.modified for file in self.files) / 1e9, timezone.utc)
            taken = newest.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        files = ";".join(file.path for file in self.files)
        for figures in self.regions or ({"status": self.status, "why": self.why},):
            row: dict[str, Value] = {"shot": self.shot, "files": files, "taken": taken, **figures}
            yield [row.get(key) for key in KEYS]


class Table(contextlib.AbstractContextManager["Table"]):
    """An open table. The context manager closes it.

    Args:
        folder: folder to create.
        settings: all settings that the figures depend on, which are equal for all shots of a table.
        overwrite: replace a table with other settings. A table without a measured shot is always replaced.
        judge: function that compares a line with the limits of the settings, for a table with other limits.

    Attributes:
        judged_again: number of lines that were compared with new limits.
        close: release the table for other processes.

    Raises:
        PolarguideError: another process writes the table, it has other settings, it is damaged before its end, or it
            cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        *,
        overwrite: bool = False,
        judge: Callable[[Entry], Entry] | None = None,
    ) -> None:
        check_out(folder)
        make_folder(folder)
        self.folder = folder
        self.judged_again = 0
        self._done: dict[bytes, Entry] = {}
        self._pictures: set[str] = set()
        self._files: list[BinaryIO] = []
        with contextlib.ExitStack() as stack:
            found = "another polarguide measure at work on it"
            stack.enter_context(
                only_writer(folder / LOCK, expected="a table without another writer", found=found)
            )
            self._open({"format": FORMAT, **settings}, overwrite, judge)
            for name in (LINES, CSV):
                with writing(folder / name):
                    self._files.append(stack.enter_context(open(folder / name, "ab", buffering=0)))
            self.close = stack.pop_all().close

    def __exit__(self, *_: object) -> None:
        self.close()

    def entry_of(self, files: tuple[FileStamp, ...]) -> Entry | None:
        """Return the line of files in their current state, or None. Only a line beyond its limits has figures."""
        return self._done.get(_key(files))

    def picture_name(self, shot: str) -> str:
        """Return a new name for the pictures of a shot, unique without regard to case."""
        names = itertools.chain((shot,), (f"{shot}-{number}" for number in itertools.count(2)))
        return next(name for name in names if name.casefold() not in self._pictures)

    def add(self, entry: Entry) -> Entry:
        """Write the lines of a shot, force them to disk, and return the entry.

        Raises:
            PolarguideError: the lines cannot be written, as on a full disk, or the table was removed.
        """
        self.require_present()
        lines, rows = self._files
        _append(self.folder / LINES, lines, entry.line())
        self._record(entry)
        _append(self.folder / CSV, rows, _csv(entry.rows()))
        return entry

    def require_present(self) -> None:
        """Check that the open files still exist under their names. A removed file would lose lines silently.

        Raises:
            PolarguideError: a file was removed, renamed or replaced.
        """
        for name, file in zip((LINES, CSV), self._files, strict=True):
            path = self.folder / name
            present = False
            with contextlib.suppress(OSError):
                present = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
            require(
                present,
                path,
                expected="the table that was opened",
                found="a removed, renamed or replaced file",
                remedy="Restore it if possible; the same command measures the missing shots.",
            )

    def _record(self, entry: Entry) -> None:
        """Keep a line in memory, with figures if it is beyond its limits."""
        short = entry if entry.status == "beyond" else msgspec.structs.replace(entry, regions=(), notes=())
        self._done[_key(entry.files)] = short
        if entry.picture:
            self._pictures.add(entry.picture.casefold())

    def _open(
        self, settings: dict[str, Any], overwrite: bool, judge: Callable[[Entry], Entry] | None
    ) -> None:
        """Repair an existing table, or create a new one.

        Raises:
            PolarguideError: the table has other settings, is damaged, or cannot be written.
        """
        path = self.folder / SETTINGS
        lines = self.folder / LINES
        for place in (path, lines):
            if os.path.lexists(place):  # the folder may come from another user
                require_inside(self.folder, place)
                require_file(place, expected="a file of a table", remedy=_REPLACE)
        if path.exists() and lines.exists():
            before = read_record(path, dict[str, Any], remedy=_REPLACE) if not overwrite else None
            now: dict[str, Any] = json.loads(to_json(settings))
            without_limits = {**now, "limits": None}
            if before == now:
                self._repair()
                return
            if judge is not None and before is not None and {**before, "limits": None} == without_limits:
                # Settings without limits mark a table whose lines are compared with new limits.
                write_whole(path, to_json(without_limits))
                self._repair()
                self._judge(judge)
                write_whole(path, to_json(settings))
                self._repair()
                return
            if before is not None and _has_measurements(lines):
                name, was, requested = first_differing_value("", before, now)
                raise PolarguideError(
                    f"{path} ({name[1:]})",
                    expected=shortened(was, 200),
                    found=shortened(requested, 200),
                    remedy=f"One table has one set of options. {_REPLACE}",
                )
        elif not overwrite:
            require(
                not lines.exists(),
                path,
                expected="the options of this table",
                found="no file",
                remedy=_REPLACE,
            )
            require(
                not os.path.lexists(self.folder / CSV),
                self.folder / CSV,
                expected=f"a new table, or a table with {LINES}",
                found="a file of this name only",
                remedy=_REPLACE,
            )
        write_whole(lines, b"")
        write_whole(path, to_json(settings))
        self._repair()

    def _repair(self) -> None:
        """Read all lines, remove an incomplete last line, and recreate the CSV table.

        Raises:
            PolarguideError: a line is invalid, or a file cannot be written.
        """
        path = self.folder / LINES
        self._done.clear()
        self._pictures.clear()
        complete = 0
        with atomic(self.folder / CSV) as temporary, open(temporary, "wb") as rows, open(path, "rb") as lines:
            rows.write(_csv([list(KEYS)]))
            for number, line in enumerate(lines, 1):
                if not line.endswith(b"\n"):
                    break
                entry = decode(line, Entry, f"{path} (line {number})", remedy=_REPLACE)
                place = f"{path} (line {number}, format)"
                found = str(entry.format)
                require(entry.format == FORMAT, place, expected=str(FORMAT), found=found, remedy=_REPLACE)
                self._record(entry)
                rows.write(_csv(entry.rows()))
                complete += len(line)
        if complete < path.stat().st_size:
            with writing(path), open(path, "r+b") as file:
                file.truncate(complete)
                os.fsync(file.fileno())

    def _judge(self, judge: Callable[[Entry], Entry]) -> None:
        """Compare all lines with new limits, and replace them."""
        path = self.folder / LINES
        with atomic(path) as temporary, open(temporary, "wb") as new, open(path, "rb") as lines:
            for number, line in enumerate(lines, 1):
                entry = judge(decode(line, Entry, f"{path} (line {number})", remedy=_REPLACE))
                if entry.status == "beyond" and not entry.picture:
                    entry = msgspec.structs.replace(entry, picture=self.picture_name(entry.shot))
                    self._pictures.add(entry.picture.casefold())
                new.write(entry.line())
                self.judged_again += 1


def _append(path: Path, file: BinaryIO, data: bytes) -> None:
    """Append data to a file completely or not at all, and force it to disk."""
    with writing(path):
        size = os.fstat(file.fileno()).st_size
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        except BaseException:
            with contextlib.suppress(OSError):
                file.truncate(size)
            raise


def _csv(rows: Iterable[Iterable[object]]) -> bytes:
    return csv_lines(rows).encode("utf-8", "backslashreplace")


def _key(files: tuple[FileStamp, ...]) -> bytes:
    return hashlib.sha256(json.dumps(msgspec.to_builtins(files)).encode()).digest()[:16]


def _has_measurements(path: Path) -> bool:
    with open(path, "rb") as lines:
        return any(b'"status": "unread"' not in line for line in lines)
