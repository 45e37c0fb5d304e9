"""Measure the shots of a watched folder, each once, as soon as its files are complete."""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.exposure_files import is_lone_exposure
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
"""Smallest and largest interval between two searches, in seconds. Slow searches have larger intervals."""


@dataclass
class _Pending:
    """State of a shot that has not been measured yet.

    Attributes:
        files: stamps of the files at the last search.
        since: time of the last change of a file.
        truncated: True if reading failed because a file may be incomplete.
        reported: True if a warning about missing files was printed.
    """

    files: tuple[FileStamp, ...]
    since: float
    truncated: bool = False
    reported: bool = False


@dataclass
class _Folder:
    """Searches a watched folder for shots.

    Attributes:
        root: the folder.
        reading: options of reading.
        reporter: receiver of warnings.
        ignored: real paths of files that are not shots.
        patience: seconds after which an error is reported.
    """

    root: Path
    reading: ShotOptions
    reporter: Reporter
    ignored: frozenset[str]
    patience: float
    _error: tuple[str, float] = ("", 0.0)
    _reported: str = ""

    def shots(self) -> list[ExposureSet]:
        """Return all shots in the folder, including incomplete shots."""
        # An error may be temporary: the first of four folders, or a network that is down.
        try:
            shots = [
                shot
                for shot in self._search()
                if not any(os.path.realpath(path) in self.ignored for path in shot.paths)
            ]
            self._error = ("", 0.0)
        except (PolarguideError, OSError) as error:
            shots = []
            self._keep(error)
        return shots

    def _search(self) -> list[ExposureSet]:
        if self.reading.sensor is None:
            return list_shots([self.root], self.reading)
        files = sorted(path for path in self.root.iterdir() if path.suffix.lower() in RAW_SUFFIXES)
        return mosaics([path for path in files if not path.name.startswith(".") and path.is_file()])

    def trouble(self) -> str:
        """Return the reason why no shot was found in a folder that is not empty. Otherwise return an empty string."""
        return self._error[0] if self._error[0] and self._has_files() else ""

    def _keep(self, error: PolarguideError | OSError) -> None:
        """Record an error, and report it once if it persists longer than the patience."""
        text = str(error)
        if isinstance(error, OSError):
            found = error.strerror or text
            text = f"{self.root}: expected a readable folder, found {found}. Restore it, or watch another folder."
        now = time.monotonic()
        if text != self._error[0]:
            self._error = (text, now)
        elif now - self._error[1] >= self.patience and text != self._reported and self._has_files():
            self._reported = text
            self.reporter.warn(text)

    def _has_files(self) -> bool:
        """Return False if the folder is readable and empty, else True."""
        with contextlib.suppress(OSError):
            return any(not path.name.startswith(".") for path in self.root.iterdir())
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
    """Measure the shots of a folder as they arrive, until ``should_stop`` returns True.

    A shot is measured when all its files are complete and unchanged for ``settle`` seconds. An incomplete file is
    retried. After ``patience`` seconds without a change, the error of the shot is written to the table. The same
    applies to an ambiguous file, and to a file without an angle in its name.

    A shot with fewer than four files waits. A warning follows after ``patience`` seconds, and the shot is in
    ``Outcome.waiting`` at the end. A set at other angles is measured when its angles are evenly spaced over half a turn
    or all files of ``angles.csv`` exist. If neither holds, it is measured after ``patience`` seconds without a change.
    The same applies to a single exposure whose name states the stops, because further exposures may follow.

    A rewritten file is a new shot. If the process stops or is killed, the same call continues with the shots that are
    not in the table.

    Args:
        folder: folder of mosaics or of shots through a filter (see ``find_shots``).
        out: folder of the table.
        options: quantities to measure, and their limits.
        reading: options of reading.
        watching: intervals.
        should_stop: function that returns True to stop. It is called between two shots and several times per second.
        heard: callback for each shot after its line is on disk.
        reporter: receiver of messages.

    Raises:
        PolarguideError: the folder is missing, an option is invalid, or the table cannot be written.
    """
    root = Path(folder)
    require_folder(root, expected="a folder to watch", remedy="Check --watch.")
    require_elsewhere([root], Path(out))
    reading.require_kind("filter" if reading.sensor is None else "mosaic", root.name)
    counts: Counter[str] = Counter()
    with Line(Path(out), options, reading) as line:
        ignored = [*line.measurer.reference_files, *([reading.dark_frame] if reading.dark_frame else [])]
        search = _Folder(
            root, reading, reporter, frozenset(map(os.path.realpath, ignored)), watching.patience
        )
        watch = _Watch(line, watching, reporter)
        step = min(max(watching.settle / 2, _POLL[0]), _POLL[1])
        while not (should_stop() or watch.idle()):
            begin = time.monotonic()
            shots = search.shots()
            duration = time.monotonic() - begin
            line.table.require_present()
            for entry in watch.measure(shots):
                heard(entry)
                counts[entry.status] += 1
                if should_stop():
                    break
            time.sleep(max(step, 4 * duration))
        line.table.require_present()
        return Outcome(Path(out), counts, 0, tuple(sorted(watch.pending)), search.trouble())


class _Watch:
    """Decides when the shots of a watched folder are measured.

    Attributes:
        pending: shots that have not been measured yet, by name.
    """

    def __init__(self, line: Line, options: WatchOptions, reporter: Reporter) -> None:
        self._line = line
        self._options = options
        self._reporter = reporter
        self.pending: dict[str, _Pending] = {}
        self._changed = time.monotonic()

    def measure(self, shots: Sequence[ExposureSet]) -> Iterator[Entry]:
        """Measure the complete shots, the oldest first. Yield each line after it is on disk."""
        pending: dict[str, _Pending] = {}
        ready = []
        for shot in shots:
            try:
                files = stamps(shot.paths)
            except (PolarguideError, OSError):  # a file was removed since the search
                continue
            if self._line.table.entry_of(files) is not None:
                continue
            state = self.pending.get(shot.name)
            if state is None or state.files != files:
                self._changed = time.monotonic()
                state = _Pending(files, self._changed)
            pending[shot.name] = state
            if self._is_ready(shot, state):
                ready.append((max(file.modified for file in files), shot.name, shot))
        self.pending = pending
        for _, name, shot in sorted(ready, key=lambda item: item[:2]):
            entry = self._measure(shot, pending[name])
            if entry is not None:
                self._changed = time.monotonic()
                del pending[name]
                yield entry

    def _is_ready(self, shot: ExposureSet, state: _Pending) -> bool:
        """Return True if a shot can be measured now."""
        age = time.monotonic() - state.since
        late = age >= self._options.patience
        missing = [str(angle) for angle in ANGLES if angle not in shot.files]
        if age < self._options.settle:
            return False
        if shot.fault is not None:  # a later file or name may resolve it
            return late
        if shot.kind == "set" and not shot.complete:
            return late
        if any(map(is_lone_exposure, shot.files.values())):  # further exposures may follow
            return late
        if shot.kind != "filter" or not missing:
            return late or not state.truncated
        if late and not state.reported:
            state.reported = True
            self._reporter.warn(
                f"{shot.name}: still no picture at {' and '.join(missing)} degrees; it waits."
            )
        return False

    def _measure(self, shot: ExposureSet, state: _Pending) -> Entry | None:
        """Measure a shot, or write a line with its error.

        Return None if the shot has changed since the search, or if its files may be incomplete.
        """
        try:
            return self._line.measure(shot, state.files) if stamps(shot.paths) == state.files else None
        except ChangedWhileRead:
            return None
        except UNREADABLE as error:
            late = time.monotonic() - state.since >= self._options.patience
            try:
                changed = stamps(shot.paths) != state.files
                state.truncated = not changed and not late and not all(map(_is_complete, shot.paths))
            except (PolarguideError, OSError):
                return None
            return None if changed or state.truncated else self._line.unread(shot, state.files, error)

    def idle(self) -> bool:
        """Return True if nothing has changed for the ``idle`` time. Return False while a file may still change."""
        quiet = time.monotonic() - self._changed
        return 0 < self._options.idle <= quiet and quiet > self._options.settle + 2 * _POLL[1]


def _is_complete(path: Path) -> bool:
    """Return True if a file is a table, or a complete PNG, JPEG or TIFF file.

    Return False for formats that do not show whether a file is complete.
    """
    suffix = path.suffix.lower()
    return suffix == ".csv" or (suffix in SUFFIXES and find_damage(path.read_bytes()) is None)
