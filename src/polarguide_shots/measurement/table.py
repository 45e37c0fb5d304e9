"""The table of a folder of shots on disk: it survives a kill at any moment without a lost or a doubled line.

``table.jsonl`` has one line per shot, with all of its regions and the files that it was read from: it is the table
and the journal of what is done in one, so that the two cannot disagree. A line is written in one piece and forced to
disk before anything else happens; what a kill leaves of one is cut off at the next start, and its shot is measured
again.
``table.csv`` has one line per region. It is written after the other, and made anew from it at every start.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import msgspec
from msgspec import Meta

from polarguide.core.errors import PolarguideError
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
"""Of the nanoseconds that a time may lie from 1970, 292 years; some disks have later ones."""
_ANEW = "Give another --out, or --overwrite to begin this table anew."


class FileStamp(msgspec.Struct, frozen=True):
    """A file as it was read: path, size in bytes, and time of its last change in nanoseconds."""

    path: str
    bytes: int
    modified: Annotated[int, Meta(ge=-_LAST, le=_LAST)]


def stamps(paths: Sequence[Path]) -> tuple[FileStamp, ...]:
    """The present state of files.

    Raises:
        OSError: one is not there.
    """
    about = ((os.path.abspath(path), os.stat(path)) for path in paths)
    return tuple(
        FileStamp(path, state.st_size, min(max(state.st_mtime_ns, -_LAST), _LAST)) for path, state in about
    )


class Entry(msgspec.Struct, frozen=True):
    """One line of ``table.jsonl``.

    Attributes:
        format: ``fields.FORMAT``.
        shot: its name.
        files: it was read from.
        status: the worst of its regions; unread where it could not be read.
        why: then, the reason.
        notes: what was assumed about it.
        regions: by ``Field.key``, from ``region`` on.
        picture: name of its pictures without suffix, "" where none was drawn.
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
        """The line of ``table.jsonl``; JSON's escapes keep names that are no Unicode."""
        return json.dumps(msgspec.to_builtins(self)).encode() + b"\n"

    def rows(self) -> Iterator[list[Value]]:
        """The lines of the CSV table."""
        shared: dict[str, Value] = {
            "shot": self.shot,
            "files": ";".join(file.path for file in self.files),
            "taken": "",
        }
        if self.files:
            newest = datetime.fromtimestamp(max(file.modified for file in self.files) / 1e9, timezone.utc)
            shared["taken"] = newest.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        for figures in self.regions or ({"status": self.status, "why": self.why},):
            yield [{**shared, **figures}.get(key) for key in KEYS]


class Table(contextlib.AbstractContextManager["Table"]):
    """A table that is open for more lines. Close it, or use it as a context."""

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        *,
        overwrite: bool = False,
        judged: Callable[[Entry], Entry] | None = None,
    ) -> None:
        """Open the table of a folder, or begin one.

        Args:
            folder: is made. settings: all that the figures depend on; a table has the same for all of its shots.
            judged: a line by the limits of the settings, where the table was made with other limits alone.
            overwrite: begin anew where it was made with others; so is a table without a single measured shot.

        Raises:
            PolarguideError: another process writes it, it was made with other settings, it is damaged (but for its
                end), or it cannot be written.
        """
        check_out(folder)
        make_folder(folder)
        self.folder = folder
        self.judged_again = 0
        """Lines that were judged by other limits than before."""
        self._done: dict[bytes, Entry] = {}
        self._pictures: set[str] = set()
        self._files: list[BinaryIO] = []
        with contextlib.ExitStack() as stack:
            stack.enter_context(
                only_writer(
                    folder / LOCK,
                    expected="a table that nobody else writes",
                    found="another polarguide measure at work on it",
                )
            )
            self._begin({"format": FORMAT, **settings}, overwrite, judged)
            for name in (LINES, CSV):
                with writing(folder / name):
                    self._files.append(stack.enter_context(open(folder / name, "ab", buffering=0)))
            self.close = stack.pop_all().close
            """Let others write the table."""

    def __exit__(self, *_: object) -> None:
        self.close()

    def status_of(self, files: tuple[FileStamp, ...]) -> Status | None:
        """The status in the line of these files as they are, None where there is no such line."""
        entry = self.entry_of(files)
        return None if entry is None else entry.status

    def entry_of(self, files: tuple[FileStamp, ...]) -> Entry | None:
        """The line of these files as they are, with figures where it is beyond; None where there is no such line."""
        return self._done.get(_key(files))

    def picture_name(self, shot: str) -> str:
        """A name for the pictures of a shot that those of no other have, upper and lower case taken alike."""
        names = itertools.chain((shot,), (f"{shot}-{number}" for number in itertools.count(2)))
        return next(name for name in names if name.casefold() not in self._pictures)

    def add(self, entry: Entry) -> None:
        """Write the lines of a shot; when this returns, they are on disk.

        Raises:
            PolarguideError: the lines cannot be written, as on a full disk, or the table was removed.
        """
        self.require_there()
        lines, rows = self._files
        _append(self.folder / LINES, lines, entry.line())
        self._note(entry)
        _append(self.folder / CSV, rows, _csv(entry.rows()))

    def require_there(self) -> None:
        """Check that the files are still those that are written to: what is removed meanwhile takes lines silently.

        Raises:
            PolarguideError: one was removed, renamed or replaced.
        """
        for name, file in zip((LINES, CSV), self._files, strict=True):
            path = self.folder / name
            try:
                there = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
            except OSError:
                there = False
            if not there:
                raise PolarguideError(
                    path,
                    expected="the table that was opened",
                    found="that it was removed, renamed or replaced meanwhile",
                    remedy="Put it back if you can; the same command measures what is not in it.",
                )

    def _note(self, entry: Entry) -> None:
        short = entry if entry.status == "beyond" else msgspec.structs.replace(entry, regions=(), notes=())
        self._done[_key(entry.files)] = short
        if entry.picture:
            self._pictures.add(entry.picture.casefold())

    def _begin(
        self, settings: dict[str, Any], overwrite: bool, judged: Callable[[Entry], Entry] | None
    ) -> None:
        """Make what there is whole again, or begin anew."""
        path = self.folder / SETTINGS
        lines = self.folder / LINES
        for place in (path, lines):
            if os.path.lexists(place):  # somebody else may have made the folder
                require_inside(self.folder, place)
                require_file(place, expected="a file of a table", remedy=_ANEW)
        if path.exists() and lines.exists():
            before = read_record(path, dict[str, Any], remedy=_ANEW) if not overwrite else None
            now: dict[str, Any] = json.loads(to_json(settings))
            if before == now:
                self._mend()
                return
            if (
                judged is not None
                and before is not None
                and {**before, "limits": None} == {**now, "limits": None}
            ):
                write_whole(path, to_json({**now, "limits": None}))  # until all lines are by the same
                self._mend()
                self._judge(judged)
                write_whole(path, to_json(settings))
                self._done.clear()
                self._pictures.clear()
                self._mend()
                return
            if before is not None and _holds_measurements(lines):
                name, was, is_now = first_differing_value("", before, now)
                raise PolarguideError(
                    f"{path} ({name[1:]})",
                    expected=shortened(was, 200),
                    found=shortened(is_now, 200),
                    remedy=f"One table has one set of options. {_ANEW}",
                )
        elif lines.exists() and not overwrite:
            raise PolarguideError(
                path, expected="the options that this table was made with", found="nothing", remedy=_ANEW
            )
        elif os.path.lexists(self.folder / CSV) and not overwrite:
            raise PolarguideError(
                self.folder / CSV,
                expected=f"a new table, or one with {LINES} beside it",
                found="a file of this name alone",
                remedy=_ANEW,
            )
        write_whole(lines, b"")
        write_whole(path, to_json(settings))
        self._mend()

    def _mend(self) -> None:
        """Cut off a torn last line, note what is done, and make the CSV table anew."""
        path = self.folder / LINES
        whole = 0
        with atomic(self.folder / CSV) as temporary, open(temporary, "wb") as rows, open(path, "rb") as lines:
            rows.write(_csv([list(KEYS)]))
            for number, line in enumerate(lines, 1):
                if not line.endswith(b"\n"):
                    break
                entry = decode(line, Entry, f"{path} (line {number})", remedy=_ANEW)
                if entry.format != FORMAT:
                    raise PolarguideError(
                        f"{path} (line {number}, format)",
                        expected=str(FORMAT),
                        found=str(entry.format),
                        remedy=_ANEW,
                    )
                self._note(entry)
                rows.write(_csv(entry.rows()))
                whole += len(line)
        if whole < path.stat().st_size:
            with writing(path), open(path, "r+b") as file:
                file.truncate(whole)
                os.fsync(file.fileno())

    def _judge(self, judged: Callable[[Entry], Entry]) -> None:
        """Write all lines anew, as other limits judge them."""
        path = self.folder / LINES
        with atomic(path) as temporary, open(temporary, "wb") as new, open(path, "rb") as lines:
            for number, line in enumerate(lines, 1):
                entry = judged(decode(line, Entry, f"{path} (line {number})", remedy=_ANEW))
                if entry.status == "beyond" and not entry.picture:
                    entry = msgspec.structs.replace(entry, picture=self.picture_name(entry.shot))
                    self._pictures.add(entry.picture.casefold())
                new.write(entry.line())
                self.judged_again += 1


def _append(path: Path, file: BinaryIO, data: bytes) -> None:
    """Write at the end of a file and force it to disk: all of it, or nothing."""
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


def _csv(rows: Any) -> bytes:
    return csv_lines(rows).encode("utf-8", "backslashreplace")


def _key(files: tuple[FileStamp, ...]) -> bytes:
    return hashlib.sha256(json.dumps(msgspec.to_builtins(files)).encode()).digest()[:16]


def _holds_measurements(path: Path) -> bool:
    with open(path, "rb") as lines:
        return any(b'"status": "unread"' not in line for line in lines)
