"""``polarguide batch``."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro

from polarguide.cli.console import ConsoleReporter, say, set_threads
from polarguide.core.errors import PolarguideError, require_package
from polarguide.core.files import read_rows, stored
from polarguide.core.options import EXPORT_PACKAGES, SceneOptions, check_finite
from polarguide.core.text import canonical
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings
from polarguide.training.settings import TrainSettings
from polarguide_bench.children import NO_FILES, source_stamp
from polarguide_bench.options import BatchOptions

if TYPE_CHECKING:
    from polarguide_bench.batch import Capture

COLUMNS = ("name", "path", "sensor", "options")
_NAME = re.compile(r"[^\s./\\][^/\\\x00-\x1f]*")
"""A name that is also one of a folder."""
Parsed = TypeVar("Parsed")


def batch(
    collection: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    options: str = "",
    watch: float | None = None,
    settings: Annotated[BatchOptions, tyro.conf.arg(name="")],
) -> None:
    """Prepare, inspect, train, score, share and export every capture of a collection, with one page over all.

    Writes captures/NAME for each, and index.html and results.csv over all, to the folder given by --out. A capture that
    fails is a row with its error, and the others go on. Can be stopped with Ctrl-C at any time: the same command goes
    on, and takes failed ones up again.

    Args:
        collection: A folder of which each folder is a capture; or a CSV file with the columns name, path (from the
            file's folder), and, if need be, sensor and options.
        out: Folder to write.
        options: Options of prepare and train for all captures: --options="--poses sfm --steps 3000". Those of a line of
            the CSV file go before them.
        watch: Look for new captures every so many seconds, until Ctrl-C, as at a capture station. A capture begins once
            nothing in its folder has changed from one look to the next.
    """
    set_threads(settings.threads)
    for kind in settings.formats:
        for package in EXPORT_PACKAGES.get(kind, ()):
            require_package(package, f"--formats {kind}")

    def process(lines: Sequence[_Line]) -> None:
        running = importlib.import_module("polarguide_bench.batch")
        captures = [_capture(running.Capture, line, running.is_scene(line.path), options) for line in lines]
        rows = running.run_batch(captures, out, settings, reporter=ConsoleReporter())
        say(f"page: {out / 'index.html'}   table: {out / 'results.csv'}")
        failed = [row for row in rows if row.state == "failed"]
        if failed:
            errors = "; ".join(f"{row.name}: {row.error}" for row in failed)
            raise PolarguideError(
                out,
                expected=f"{len(rows)} finished captures",
                found=f"that {len(failed)} failed ({errors})",
                remedy="The others are finished. Remove the cause and give the same command again.",
            )

    if watch is None:
        lines = _lines(collection, out)
        if not lines:
            raise PolarguideError(
                collection,
                expected="a folder of captures, or a table of them",
                found="no capture",
                remedy="Put each capture into a folder of its own, or write a CSV file with the columns name and path.",
            )
        process(lines)
    else:
        check_finite("watch", watch, 1, 86_400)
        if not collection.is_file():
            _folders(collection, out)  # there may be none yet, but a place for them
        _watched(lambda: _lines(collection, out), process, watch)


def _watched(
    look: Callable[[], Sequence[_Line]], process: Callable[[Sequence[_Line]], None], seconds: float
) -> None:
    """Process captures as they come, until KeyboardInterrupt; what is wrong with one is printed, and the next awaited.

    Args:
        look: the captures that are there. process: those that are complete, whenever one is new or has changed.
    """
    say(f"looking for captures every {seconds:g} seconds; Ctrl-C ends it")
    earlier: dict[str, tuple[int, int, int]] = {}
    processed: dict[str, tuple[int, int, int]] = {}
    told = ""
    while True:
        try:
            lines = look()
            now = {line.name: source_stamp(line.path) for line in lines}
            complete = [line for line in lines if NO_FILES != now[line.name] == earlier.get(line.name)]
            earlier = now
            stamps = {line.name: now[line.name] for line in complete}
            if not stamps.items() <= processed.items():
                processed |= stamps
                process(complete)
        except PolarguideError as error:
            if str(error) != told:
                say(str(error))
            told = str(error)
        time.sleep(seconds)


@dataclass(frozen=True)
class _Line:
    """A capture as the collection names it. ``where``: its place in messages."""

    where: str
    name: str
    path: Path
    sensor: str = ""
    options: str = ""


def _lines(collection: Path, out: Path) -> list[_Line]:
    """The captures of a collection, in its order.

    Raises:
        PolarguideError: the collection is neither a folder of folders nor such a table.
    """
    lines = _table(collection) if collection.is_file() else _folders(collection, out)
    taken: dict[str, str] = {}
    for line in lines:
        if not _NAME.fullmatch(line.name):
            found = repr(line.name[:100])
            raise PolarguideError(
                line.where, expected="a name that a folder can have", found=found, remedy="Give it another."
            )
        if line.name.lower() in taken:
            raise PolarguideError(
                line.where,
                expected="names of their own",
                found=f"{line.name}, as in {taken[line.name.lower()]}",
                remedy="Name each capture once.",
            )
        taken[line.name.lower()] = line.where
    return lines


def _folders(collection: Path, out: Path) -> list[_Line]:
    if not collection.is_dir():
        raise PolarguideError(
            collection,
            expected="a folder of captures, or a CSV file",
            found="no such file or folder",
            remedy="Check the name.",
        )
    folders = sorted(path for path in collection.iterdir() if path.is_dir() and path.name[0] not in ".")
    return [
        _Line(str(path), canonical(path.name), path) for path in folders if path.resolve() != out.resolve()
    ]


def _table(file: Path) -> list[_Line]:
    """The lines of a CSV file, with commas, or semicolons as spreadsheets of some countries write them."""
    rows = read_rows(file, "Save it as CSV in UTF-8.")
    columns = [name.lower() for name in rows[0][1]] if rows else []
    if not {"name", "path"} <= set(columns) <= set(COLUMNS) or len(set(columns)) < len(columns):
        raise PolarguideError(
            f"{file} (first line)",
            expected="the columns name and path, and perhaps sensor and options",
            found=", ".join(map(repr, columns)) or "nothing",
            remedy="Write them into the first line.",
        )
    lines = []
    for number, row in rows[1:]:
        where = f"{file} (line {number})"
        if len(row) != len(columns):
            raise PolarguideError(
                where,
                expected=f"{len(columns)} values",
                found="more" if len(row) > len(columns) else "fewer",
                remedy="Put values with a delimiter in them into double quotes.",
            )
        values = dict(zip(columns, row, strict=True))
        if not values["path"]:
            raise PolarguideError(where, expected="a path", found="none", remedy="Name its folder.")
        path = stored(file.parent / values["path"])
        more = values.get("sensor", ""), values.get("options", "")
        lines.append(_Line(where, canonical(values["name"]), path, *more))
    return lines


def _capture(kind: type[Capture], line: _Line, scene: bool, common: str) -> Capture:
    """The capture of a line, with its options read.

    Raises:
        PolarguideError: an option that neither prepare nor train has, or a wrong value of one.
    """
    words = [*_words(common, "--options"), *(["--sensor", line.sensor] if line.sensor and not scene else ())]
    words += _words(line.options, line.where)
    try:
        own, rest = (None, words) if scene else _parsed(_prepared, words, unknown=True)
        (recipe, settings, reading), _ = _parsed(_trained, rest, unknown=False)
    except SystemExit:
        raise PolarguideError(
            f"{line.where} (options)",
            expected="options of train" if scene else "options of prepare and train",
            found=shlex.join(words),
            remedy="polarguide train --help and polarguide prepare --help list them.",
        ) from None
    except PolarguideError as error:
        where = f"{line.where}, {error.where}"
        raise PolarguideError(
            where, expected=error.expected, found=error.found, remedy=error.remedy
        ) from None
    capture = kind(line.name, line.path, recipe=recipe, settings=settings, reading=reading)
    return capture if own is None else replace(capture, prepare=own)


def _words(text: str, where: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise PolarguideError(
            where,
            expected="options as on the command line",
            found=f"{text!r}: {error}",
            remedy="Close the quotes.",
        ) from None


def _parsed(kind: Callable[..., Parsed], words: Sequence[str], *, unknown: bool) -> tuple[Any, list[str]]:
    """The result of a function called with words of a command line, and the words that are not its options."""
    function = tyro.conf.configure(tyro.conf.OmitArgPrefixes)(kind)
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        if unknown:
            value, rest = tyro.cli(function, args=words, return_unknown_args=True)
            return value, rest
        return tyro.cli(function, args=words), []


def _prepared(
    settings: Annotated[PrepareSettings, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
) -> PrepareSettings:
    return replace(settings, calibration=angles.read(), analyzers=angles.analyzers()).checked()


def _trained(
    recipe: str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    reading: SceneOptions = SceneOptions(),
) -> tuple[str, TrainSettings, SceneOptions]:
    return recipe, settings, reading
