"""The table of measured shots: its fields, its limits files, and its files on disk.

``table.jsonl`` has one line per shot, with all regions and files. It is the table, and also the journal that prevents a
shot from being measured twice. A line is written at once and forced to disk before the next step. If the process is
killed, the next start removes an incomplete line, and its shot is measured again. No line is lost or repeated.
``table.csv`` has one line per region. It is written after ``table.jsonl`` and recreated from it at every start.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

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

FORMAT = 2
"""Version of the table. It increases whenever the name, order or meaning of a field changes."""
PERCENTILES = (1, 5, 50, 95, 99)
"""Percentiles of S0 and DoLP that are in the table."""
DIFFERENCE_PERCENTILE = 99
"""Percentile of the absolute differences from the reference that is in the table."""
Value = int | float | str | None

Status = Literal["measured", "within", "beyond", "unread"]


@dataclass(frozen=True)
class Field:
    """Description of a field of the table.

    Attributes:
        key: name of the field.
        unit: unit of the numbers. Empty if they have no unit.
        about: description.
        bounded: True if a limits file may contain a limit for the field.
    """

    key: str
    unit: str
    about: str
    bounded: bool = True


def _spread(key: str, unit: str, what: str) -> tuple[Field, ...]:
    return (
        Field(f"{key}_mean", unit, f"mean of {what}"),
        Field(f"{key}_error", unit, f"standard error of {key}_mean by the sensor's noise"),
        Field(f"{key}_deviation", unit, f"standard deviation of {what}"),
        *(Field(f"{key}_p{p}", unit, f"{p}th percentile of {what}") for p in PERCENTILES),
    )


def _difference(key: str, unit: str, what: str, mean: str, more: str = "") -> tuple[Field, ...]:
    return (
        Field(f"{key}_difference", unit, f"{mean} of the shot's {what} less that of the reference{more}"),
        Field(f"{key}_difference_rms", unit, f"root mean square of the difference in {what}"),
        Field(
            f"{key}_difference_p{DIFFERENCE_PERCENTILE}",
            unit,
            f"{DIFFERENCE_PERCENTILE}th percentile of the absolute difference in {what}",
        ),
    )


FIELDS = (
    Field("shot", "", "name of the shot", False),
    Field("files", "", "paths of the files, separated by semicolons", False),
    Field("taken", "", "time of the last change of the files, UTC; empty for a shot without files", False),
    Field("region", "", "name of the region; empty for a shot that could not be read", False),
    Field("x", "pixels", "left column of the region", False),
    Field("y", "pixels", "top row of the region", False),
    Field("width", "pixels", "of the region", False),
    Field("height", "pixels", "of the region", False),
    Field("status", "", "measured (without a limit), within, beyond (a limit), or unread", False),
    Field("why", "", "the exceeded limits, or the reason why the shot could not be read", False),
    Field("pixels", "pixels", "in the region"),
    Field("usable", "pixels", "with a valid angle"),
    Field("noise", "pixels", "whose DoLP is not above its noise"),
    Field("dark", "pixels", "whose light is not above the noise"),
    Field("saturated", "pixels", "with a sample at full scale"),
    Field("masked", "pixels", "marked as invalid, or outside of the mask"),
    Field("usable_share", "", "usable / pixels"),
    *_spread("s0", "full scale", "S0 (at most 2) over pixels that are usable or have the reason noise"),
    *_spread("dolp", "", "the debiased DoLP over the same pixels"),
    Field("dolp_threshold", "", "the option --threshold", False),
    Field("dolp_share", "", "share of the same pixels whose debiased DoLP is over the threshold"),
    Field("aolp_mean", "degrees", "circular mean of the AoLP over usable pixels, 0 to 180"),
    Field("aolp_error", "degrees", "standard error of aolp_mean by the sensor's noise"),
    Field("aolp_deviation", "degrees", "circular standard deviation of the AoLP over usable pixels"),
    Field(
        "aolp_concentration", "", "mean resultant length of the doubled angles: 1 all alike, 0 no direction"
    ),
    Field("compared", "pixels", "with S0 and DoLP in both the shot and the reference"),
    Field("compared_angles", "pixels", "usable in both"),
    *_difference("s0", "full scale", "S0", "mean"),
    *_difference("dolp", "", "debiased DoLP", "mean"),
    *_difference("aolp", "degrees", "AoLP", "circular mean", ", -90 to 90"),
)
"""Fields in the order of the columns. A missing value is an empty cell in CSV, and null in JSON."""
KEYS = tuple(field.key for field in FIELDS)
"""Names of the fields of the table, in the order of the columns."""
BOUNDED = tuple(field.key for field in FIELDS if field.bounded)
"""Names of the fields for which a limits file may contain a limit."""
COMPARED = KEYS[KEYS.index("compared") :]
"""Names of the fields that are only measured if there is a reference."""
AXIAL = ("aolp_mean",)
"""Names of the fields whose values are angles with a period of 180 degrees."""
_REMEDY = "Correct the file."


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Smallest and largest allowed value of a field. None means that there is no limit on this side."""

    min: float | None = None
    max: float | None = None


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a limits file.

    Attributes:
        format: version of the file, 1.
        limits: bounds by field, for all regions.
        regions: bounds by region and field. They replace the bounds in ``limits``.
    """

    format: int = 1
    limits: dict[str, Bound] = {}
    regions: dict[str, dict[str, Bound]] = {}

    def of(self, region: str) -> dict[str, Bound]:
        """Return the bounds that apply to a region, by field."""
        return {**self.limits, **self.regions.get(region, {})}


NO_LIMITS = Limits()
"""Limits that allow all values."""


def read_limits(path: Path, regions: Collection[str], *, reference: bool) -> Limits:
    """Read a limits file.

    Args:
        path: JSON file ``{"limits": {field: {"min": a, "max": b}}, "regions": {region: {field: ...}}}``.
        regions: names of the regions.
        reference: True if shots are compared with a reference.

    Raises:
        PolarguideError: the file cannot be read, a field or region is unknown, or the file contains no limit.
    """
    limits = read_record(path, Limits, remedy=_REMEDY)
    _require(limits.format == 1, f"{path} (format)", "1", str(limits.format))
    places = {"limits": limits.limits}
    for region, bounds in limits.regions.items():
        _require(region in regions, f"{path} (regions)", f"a region of --roi: {', '.join(regions)}", region)
        places[f"regions.{region}"] = bounds
    for place, bounds in places.items():
        for field, bound in bounds.items():
            _check(f"{path} ({place}.{field})", field, bound, reference)
    _require(any(places.values()), f"{path} (limits)", "a bound of at least one field", "none")
    return limits


def _check(where: str, field: str, bound: Bound, reference: bool) -> None:
    """Check that a limits file may contain a bound for a field, and that the bound is valid.

    Raises:
        PolarguideError: the field is unknown or needs a reference, or the bound is invalid.
    """
    near = " or ".join(difflib.get_close_matches(field, BOUNDED, 3, 0.5))
    hint = f"Similar fields are {near}." if near else _REMEDY
    _require(field in BOUNDED, where, "a field of the table", field, hint)
    _require(
        reference or field not in COMPARED,
        where,
        "a golden part, because this field limits the difference from it",
        "none",
        "Give the golden part with --reference, or remove the field.",
    )
    numbers = [value for value in (bound.min, bound.max) if value is not None]
    found = " and ".join(f"{value:g}" for value in numbers) or "neither"
    _require(numbers, where, "min, max or both", found)
    if field in AXIAL:
        _require(all(0 <= value <= 180 for value in numbers), where, "angles from 0 to 180", found)
    else:
        _require(numbers[0] <= numbers[-1], where, "a min up to the max", found)


def _require(condition: object, where: str, expected: str, found: str, remedy: str = _REMEDY) -> None:
    require(condition, where, expected=expected, found=found, remedy=remedy)


def faults(figures: Mapping[str, Value], bounds: Mapping[str, Bound]) -> list[str]:
    """Describe each value that is outside of its bounds. A missing value counts as outside."""
    beyond = []
    for field, bound in bounds.items():
        value = figures[field]
        low = -math.inf if bound.min is None else bound.min
        high = math.inf if bound.max is None else bound.max
        if not isinstance(value, int | float):
            beyond.append(f"{field} has no value")
        elif low > high:  # the allowed angles contain 180
            if high < value < low:
                beyond.append(f"{field} {value:.5g} outside {low:g} through 180 to {high:g}")
        elif not low <= value <= high:
            limit = f"under {low:g}" if value < low else f"over {high:g}"
            beyond.append(f"{field} {value:.5g} {limit}")
    return beyond


def verdict(beyond: Sequence[str], bounds: Mapping[str, Bound]) -> dict[str, Value]:
    """Return the fields of a region for its status and its exceeded limits."""
    return {
        "status": "beyond" if beyond else "within" if bounds else "measured",
        "why": ", ".join(beyond),
    }


def worst(regions: Sequence[Mapping[str, Value]]) -> Status:
    """Return the worst status among regions."""
    statuses = [figures["status"] for figures in regions]
    return "beyond" if "beyond" in statuses else "within" if "within" in statuses else "measured"


LINES = "table.jsonl"
CSV = "table.csv"
SETTINGS = "measure.json"
LOCK = ".lock"
_LAST = 2**63 - 1
"""Largest time of a file in nanoseconds since 1970. Later times, which some disks state, are replaced by it."""
_REPLACE = "Give another --out, or --overwrite to replace this table."


class FileStamp(msgspec.Struct, frozen=True):
    """Identity of a file, to detect changes: path, size in bytes, and time of its last change in nanoseconds."""

    path: str
    bytes: int
    modified: Annotated[int, Meta(ge=-_LAST, le=_LAST)]


def stamps(paths: Sequence[Path]) -> tuple[FileStamp, ...]:
    """Return the current ``FileStamp`` of each file.

    Raises:
        OSError: a file is missing.
    """
    states = ((os.path.abspath(path), os.stat(path)) for path in paths)
    return tuple(
        FileStamp(path, state.st_size, min(max(state.st_mtime_ns, -_LAST), _LAST)) for path, state in states
    )


class Entry(msgspec.Struct, frozen=True):
    """One line of ``table.jsonl``: the result for one shot.

    Attributes:
        format: ``FORMAT``.
        shot: name of the shot.
        files: stamps of the files of the shot.
        status: worst status of the regions, or "unread" for a shot that could not be read.
        why: error of an unread shot, else empty.
        notes: assumptions about the shot.
        regions: measured values of each region by ``Field.key``. The first key is ``region``.
        picture: name of the pictures without suffix. Empty if there are no pictures.
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
        """Return the line of ``table.jsonl``. Names that are not valid Unicode are preserved by escapes of JSON."""
        return json.dumps(msgspec.to_builtins(self)).encode() + b"\n"

    def rows(self) -> Iterator[list[Value]]:
        """Return the lines of ``table.csv``, one for each region."""
        taken = ""
        if self.files:
            newest = datetime.fromtimestamp(max(file.modified for file in self.files) / 1e9, timezone.utc)
            taken = newest.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        files = ";".join(file.path for file in self.files)
        for figures in self.regions or ({"status": self.status, "why": self.why},):
            row: dict[str, Value] = {"shot": self.shot, "files": files, "taken": taken, **figures}
            yield [row.get(key) for key in KEYS]


class Table(contextlib.AbstractContextManager["Table"]):
    """A table that is open for writing. The context manager closes it.

    Args:
        folder: folder to create.
        settings: all settings that influence the measured values. They must be equal for all shots of a table.
        overwrite: True to replace a table with other settings. A table without a measured shot is always replaced.
        judge: function that compares a line with the limits of the settings. It is called for each line if the table
            was written with other limits.

    Attributes:
        judged_again: number of lines that were compared with new limits.
        close: release the table for other processes.

    Raises:
        PolarguideError: another process writes the table, it has other settings, a line before its end is damaged, or
            it cannot be written.
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
            stack.enter_context(
                only_writer(
                    folder / LOCK,
                    expected="a table without another writer",
                    found="another polarguide measure at work on it",
                )
            )
            self._open({"format": FORMAT, **settings}, overwrite, judge)
            for name in (LINES, CSV):
                with writing(folder / name):
                    self._files.append(stack.enter_context(open(folder / name, "ab", buffering=0)))
            self.close = stack.pop_all().close

    def __exit__(self, *_: object) -> None:
        self.close()

    def entry_of(self, files: tuple[FileStamp, ...]) -> Entry | None:
        """Return the line of some files, or None if the files are not in the table or have changed.

        Only a line whose status is "beyond" has measured values.
        """
        return self._done.get(_key(files))

    def picture_name(self, shot: str) -> str:
        """Return a new name for the pictures of a shot. It is unique even if case is ignored."""
        names = itertools.chain((shot,), (f"{shot}-{number}" for number in itertools.count(2)))
        return next(name for name in names if name.casefold() not in self._pictures)

    def add(self, entry: Entry) -> Entry:
        """Write the line of a shot, force it to disk, and return the entry.

        Raises:
            PolarguideError: the line cannot be written, for example because the disk is full, or the table was removed.
        """
        self.require_present()
        lines, rows = self._files
        _append(self.folder / LINES, lines, entry.line())
        self._record(entry)
        _append(self.folder / CSV, rows, _csv(entry.rows()))
        return entry

    def require_present(self) -> None:
        """Check that the open files still exist under their names. Lines in a removed file would be lost silently.

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
        """Keep a line in memory. Measured values are only kept if its status is "beyond"."""
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
                    remedy=f"All shots of a table need the same options. {_REPLACE}",
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
                require(
                    entry.format == FORMAT,
                    place,
                    expected=str(FORMAT),
                    found=str(entry.format),
                    remedy=_REPLACE,
                )
                self._record(entry)
                rows.write(_csv(entry.rows()))
                complete += len(line)
        if complete < path.stat().st_size:
            with writing(path), open(path, "r+b") as file:
                file.truncate(complete)
                os.fsync(file.fileno())

    def _judge(self, judge: Callable[[Entry], Entry]) -> None:
        """Compare all lines with new limits, and rewrite the file."""
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
