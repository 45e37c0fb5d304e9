"""Watch a folder: measure shots as their files come, each once, and none that is half written."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from polarguide.capture.formats.headers import find_damage
from polarguide.capture.formats.pictures import SUFFIXES
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_folder
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide_shots.exposures import list_shots, mosaics, require_elsewhere
from polarguide_shots.measurement.line import ChangedWhileRead, Heard, Line, Outcome, ignore
from polarguide_shots.measurement.table import Entry, FileStamp, stamps
from polarguide_shots.options import MeasureOptions, ShotOptions, WatchOptions
from polarguide_shots.read import UNREADABLE
from polarguide_shots.sets import ExposureSet

_POLL = (0.05, 0.5)
"""Seconds between two looks, at least and at most, unless a look takes long itself."""


@dataclass
class _Coming:
    """A shot that is not in the table.

    Attributes:
        files: as they were when last looked at. since: when they became so.
        doubtful: reading them failed in a way that more bytes may fix. reported: that it is incomplete.
    """

    files: tuple[FileStamp, ...]
    since: float
    doubtful: bool = False
    reported: bool = False


@dataclass
class _Folder:
    """The contents of a watched folder."""

    root: Path
    reading: ShotOptions
    reporter: Reporter
    ignored: frozenset[str]
    patience: float
    _trouble: tuple[str, float] = field(default=("", 0.0))
    _said: str = ""

    def shots(self) -> list[ExposureSet]:
        """The shots that are there, the oldest first; of those of several files, parts, too."""
        try:
            shots = (
                self._mosaics() if self.reading.sensor is not None else list_shots([self.root], self.reading)
            )
        except PolarguideError as error:  # perhaps only the first of four folders is there: this may pass
            self._worry(str(error))
            return []
        except OSError as error:  # the network may be gone for a while
            self._worry(
                f"{self.root}: expected a folder that can be read, found {error.strerror or error}. Bring it back, or "
                "watch another."
            )
            return []
        self._trouble = ("", 0.0)
        return [shot for shot in shots if not any(os.path.realpath(p) in self.ignored for p in shot.paths)]

    def _mosaics(self) -> list[ExposureSet]:
        files = sorted(path for path in self.root.iterdir() if path.suffix.lower() in RAW_SUFFIXES)
        return mosaics([path for path in files if not path.name.startswith(".") and path.is_file()])

    def trouble(self) -> str:
        """Why nothing can be found in the folder, where that is so and there is something in it."""
        return self._trouble[0] if self._trouble[0] and self._not_empty() else ""

    def _worry(self, text: str) -> None:
        """Warn of what does not pass, once."""
        now = time.monotonic()
        if text != self._trouble[0]:
            self._trouble = (text, now)
        elif now - self._trouble[1] >= self.patience and text != self._said and self._not_empty():
            self._said = text
            self.reporter.warn(text)

    def _not_empty(self) -> bool:
        try:
            return any(not path.name.startswith(".") for path in self.root.iterdir())
        except OSError:
            return True


def watch_folder(
    folder: PathLike,
    out: PathLike,
    options: MeasureOptions = MeasureOptions(),
    reading: ShotOptions = ShotOptions(),
    watching: WatchOptions = WatchOptions(),
    *,
    should_stop: Callable[[], bool] = lambda: False,
    heard: Heard = ignore,
    reporter: Reporter = SILENT,
) -> Outcome:
    """Measure the shots of a folder as they come, until ``should_stop``.

    A shot is measured when none of its files has changed for ``settle`` seconds and all are whole. One that cannot be
    read is tried again as long as its format says that it is not whole; after ``patience`` seconds without a change it
    gets a line that says why, and so does what is ambiguous or has no angle in its name. A shot of fewer than four
    files is waited for: after ``patience`` seconds a warning says so, and it is among those ``waiting`` at the end. A
    set at other angles is measured when its angles are evenly spaced over half a turn or all files of ``angles.csv``
    are there, any other after ``patience`` seconds without a change. A file that is written anew is another shot. The
    table is the memory: the same call after a stop or a kill goes on with what is not in it.

    Args:
        folder: of mosaics, or of shots through a filter, as ``shots.exposures.find_shots`` takes it.
        out: folder of the table.
        options, reading, watching: what is measured, how shots are read, how long is waited.
        should_stop: is asked between two shots and several times a second.
        heard: is called with each shot when its line is on disk. reporter: takes messages.

    Raises:
        PolarguideError: there is no such folder, an option is wrong, or the table cannot be written.
    """
    root = Path(folder)
    require_folder(root, expected="a folder to watch", remedy="Check --watch.")
    require_elsewhere([root], Path(out))
    reading.require_kind("filter" if reading.sensor is None else "mosaic", root.name)
    counts: Counter[str] = Counter()
    with Line(Path(out), options, reading) as line:
        ignored = [*line.measurer.reference_files, *([reading.dark_frame] if reading.dark_frame else [])]
        there = _Folder(root, reading, reporter, frozenset(map(os.path.realpath, ignored)), watching.patience)
        watch = _Watch(line, watching, reporter)
        step = min(max(watching.settle / 2, _POLL[0]), _POLL[1])
        while not (should_stop() or watch.idle()):
            begin = time.monotonic()
            shots = there.shots()
            took = time.monotonic() - begin
            line.table.require_there()
            for entry in watch.look(shots):
                heard(entry)
                counts[entry.status] += 1
                if should_stop():
                    break
            time.sleep(max(step, 4 * took))
        line.table.require_there()
        return Outcome(Path(out), counts, 0, watch.waiting(), there.trouble())


class _Watch:
    """Which shots of a folder are to be measured now."""

    def __init__(self, line: Line, options: WatchOptions, reporter: Reporter) -> None:
        self._line = line
        self._options = options
        self._reporter = reporter
        self._coming: dict[str, _Coming] = {}
        self._news = time.monotonic()

    def look(self, shots: Sequence[ExposureSet]) -> Iterator[Entry]:
        """Measure what is ready of the shots that are there; gives each when its line is on disk."""
        coming: dict[str, _Coming] = {}
        ready = []
        for shot in shots:
            try:
                files = stamps(shot.paths)
            except OSError:  # gone again
                continue
            if self._line.table.status_of(files) is not None:
                continue
            before = self._coming.get(shot.name)
            if before is None or before.files != files:
                self._news = time.monotonic()
                before = _Coming(files, self._news)
            coming[shot.name] = before
            if self._is_ready(shot, before):
                ready.append((max(file.modified for file in files), shot, before))
        self._coming = coming
        for _, shot, state in sorted(ready, key=lambda item: (item[0], item[1].name)):
            entry = self._measure(shot, state)
            if entry is not None:
                self._news = time.monotonic()
                del coming[shot.name]
                yield entry

    def _is_ready(self, shot: ExposureSet, state: _Coming) -> bool:
        age = time.monotonic() - state.since
        if age < self._options.settle:
            return False
        late = age >= self._options.patience
        if shot.fault is not None:  # names may still change, and a file that is too many may go
            return late
        if shot.kind == "set" and not late and not shot.complete:  # more angles may come
            return False
        if shot.kind == "filter" and len(shot.files) < len(ANGLES):
            if late and not state.reported:
                state.reported = True
                missing = [str(angle) for angle in ANGLES if angle not in shot.files]
                self._reporter.warn(
                    f"{shot.name}: still no picture at {' and '.join(missing)} degrees; it waits."
                )
            return False
        return late or not state.doubtful

    def _measure(self, shot: ExposureSet, state: _Coming) -> Entry | None:
        try:
            if stamps(shot.paths) != state.files:
                return None
            return self._line.measure(shot, state.files)
        except ChangedWhileRead:
            return None
        except UNREADABLE as error:
            late = time.monotonic() - state.since >= self._options.patience
            try:
                changed = stamps(shot.paths) != state.files
                state.doubtful = not changed and not late and not all(map(_is_whole, shot.paths))
            except OSError:
                return None
            return None if changed or state.doubtful else self._line.unread(shot, state.files, error)

    def idle(self) -> bool:
        """Whether nothing has come for as long as the options say, and nothing is being waited for to settle."""
        quiet = time.monotonic() - self._news
        return 0 < self._options.idle <= quiet and quiet > self._options.settle + 2 * _POLL[1]

    def waiting(self) -> tuple[str, ...]:
        """Shots that are there and not in the table."""
        return tuple(sorted(self._coming))


def _is_whole(path: Path) -> bool:
    """Whether a picture's structure is complete; of files that are no PNG, JPEG or TIFF nobody can say.

    A table is taken as it is: what is wrong with it is a fault of its shot.
    """
    if path.suffix.lower() == ".csv":
        return True
    return path.suffix.lower() in SUFFIXES and find_damage(path.read_bytes()) is None
