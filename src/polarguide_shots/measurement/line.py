"""Measure regions of shots, and compare them with limits and a reference. The results may be written to a table.

The shots of a watched folder are measured once each, as soon as their files are complete.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from polarguide.capture.exposures import Angle
from polarguide.capture.formats.stored import SUFFIXES, find_damage
from polarguide.capture.layout import is_lone_exposure
from polarguide.capture.sensor.mosaics import RAW_SUFFIXES
from polarguide.capture.view import ANGLES
from polarguide.capture.view_reader import Array
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, require_folder, require_inside
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.visualization.figures import write_png
from polarguide_shots.exposures import find_shots, list_shots, mosaics, require_elsewhere
from polarguide_shots.maps import ShotMaps
from polarguide_shots.measurement.pictures import difference_picture, regions_picture
from polarguide_shots.measurement.regions import (
    WHOLE,
    Differences,
    Region,
    box_of,
    difference_figures,
    parse_regions,
    placed,
    read_reference,
    region_figures,
    subtract,
)
from polarguide_shots.measurement.table import (
    FORMAT,
    KEYS,
    NO_LIMITS,
    Entry,
    FileStamp,
    Status,
    Table,
    Value,
    faults,
    read_limits,
    stamps,
    verdict,
    worst,
)
from polarguide_shots.options import MeasureOptions, ShotOptions, WatchOptions
from polarguide_shots.read import (
    NAME,
    UNREADABLE,
    array_shot,
    check_files,
    fault_of,
    is_array,
    read_shot,
    stacked_array,
)
from polarguide_shots.sets import ExposureSet


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredShot:
    """Measurements of one shot.

    Attributes:
        maps: maps of the shot.
        differences: differences from the reference, or None.
        regions: measured values of each region by ``Field.key``. The first key is ``region``.
        status: worst status of the regions.
        beyond: all regions with their exceeded limits; empty if all regions are within their limits.
    """

    maps: ShotMaps
    differences: Differences | None
    regions: tuple[dict[str, Value], ...]
    status: Status
    beyond: Sequence[tuple[Region, Sequence[str]]]

    def entry(self, files: tuple[FileStamp, ...] = (), picture: str = "") -> Entry:
        """Return the line of the table for this shot."""
        return Entry(FORMAT, self.maps.name, files, self.status, "", self.maps.notes, self.regions, picture)


class Measurer:
    """Measures many shots in the same regions, with the same limits and reference.

    Args:
        options: quantities to measure, and their limits.
        reading: options of reading.

    Raises:
        PolarguideError: an option, the limits or the reference are invalid.
    """

    def __init__(self, options: MeasureOptions, reading: ShotOptions) -> None:
        self._reading = reading.checked()
        check_files(self._reading)
        self._options = options
        self._regions = parse_regions(options.roi)
        names = [region.name for region in self._regions] or [WHOLE]
        self.limits = NO_LIMITS
        if options.limits is not None:
            self.limits = read_limits(options.limits, names, reference=options.reference is not None)
        self.reference = None
        if options.reference is not None:
            self.reference = read_reference(options.reference, self._reading)
            placed(self._regions, self.reference.size, options.reference)
        self._part = None if self.reference is not None else box_of(self._regions)

    @property
    def reference_files(self) -> tuple[Path, ...]:
        """Files of the reference, which are skipped in a watched folder."""
        return () if self.reference is None else self.reference.files

    def read(self, shot: ExposureSet, *, whole: bool = False) -> ShotMaps:
        """Read the maps of a shot.

        The maps contain at least all regions. They contain the whole picture if ``whole`` is True or if there is a
        reference.

        Raises:
            PolarguideError, OSError, MemoryError: the shot cannot be read.
        """
        return read_shot(shot, self._reading, part=None if whole else self._part)

    def measured(self, shot: ExposureSet, maps: ShotMaps) -> MeasuredShot:
        """Compute the measured values of a shot from its maps.

        Raises:
            PolarguideError: the shot does not fit the regions or the reference.
        """
        regions = placed(self._regions, maps.whole or maps.size, shot.where)
        differences = None if self.reference is None else subtract(maps, self.reference)
        figures = []
        beyond = []
        for region in regions:
            local = dataclasses.replace(region, x=region.x - maps.origin[0], y=region.y - maps.origin[1])
            values: dict[str, Value] = {
                "region": region.name,
                "x": region.x,
                "y": region.y,
                "width": region.width,
                "height": region.height,
                "status": None,
                "why": None,
                **region_figures(maps, local, self._options.threshold),
                **difference_figures(differences, local),
            }
            bounds = self.limits.of(region.name)
            beyond.append((region, faults(values, bounds)))
            figures.append({**values, **verdict(beyond[-1][1], bounds)})
        status = worst(figures)
        return MeasuredShot(maps, differences, tuple(figures), status, beyond if status == "beyond" else [])

    def entry(self, shot: ExposureSet) -> Entry:
        """Return the line of a shot. If the shot cannot be read, the line contains the error."""
        try:
            return self.measured(shot, self.read(shot)).entry()
        except UNREADABLE as error:
            return unread_entry(shot, (), error)

    def judge(self, entry: Entry) -> Entry:
        """Compare the values in a line of the table with the limits, and update its status."""
        regions = []
        for figures in entry.regions:
            bounds = self.limits.of(str(figures["region"]))
            regions.append({**figures, **verdict(faults(figures, bounds), bounds)})
        return msgspec.structs.replace(
            entry, status=worst(regions) if regions else entry.status, regions=tuple(regions)
        )

    def settings(self) -> dict[str, Any]:
        """Return the settings that influence the measured values, as JSON data."""
        reading = {f.name: getattr(self._reading, f.name) for f in dataclasses.fields(self._reading)}
        settings = {
            "reading": reading,
            "read_files": stamps([value for value in reading.values() if isinstance(value, Path)]),
            "regions": [
                {k: v for k, v in dataclasses.asdict(region).items() if k != "corners" or v}
                for region in self._regions
            ],
            "threshold": self._options.threshold,
            "limits": self.limits,
            "reference": stamps(self.reference_files),
        }
        return dict(msgspec.to_builtins(settings, enc_hook=str))


def unread_entry(shot: ExposureSet, files: tuple[FileStamp, ...], error: BaseException) -> Entry:
    """Return the line of a shot that cannot be measured.

    Args:
        shot: the shot.
        files: ``stamps`` of its files.
        error: exception of a type in ``UNREADABLE``.
    """
    return Entry(FORMAT, shot.name, files, "unread", str(fault_of(shot, error)), (), ())


BEYOND = "beyond"
"""Name of the folder for pictures of shots that exceed a limit."""
DIFFERENCES = "differences"
"""Name of the folder for pictures of the differences from the reference."""
Heard = Callable[[Entry], None]
"""Callback that receives the line of each measured shot."""


def ignore(entry: Entry) -> None:
    """Do nothing with the line of a shot. This is the default callback."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of measuring shots, or of watching a folder.

    Attributes:
        folder: folder of the table. None without a table.
        counts: numbers of shots by status. For ``measure_shots``, they include shots that were in the table before. For
            ``watch_folder``, only new shots count.
        earlier: number of shots that were in the table before. Always 0 for ``watch_folder``.
        waiting: names of incomplete shots of a watched folder.
        trouble: reason why no shot was found in a watched folder that is not empty. Otherwise an empty string.
        entries: lines of the shots if there is no table.
    """

    folder: Path | None
    counts: Counter[str]
    earlier: int = 0
    waiting: tuple[str, ...] = ()
    trouble: str = ""
    entries: tuple[Entry, ...] = ()

    @property
    def rows(self) -> list[dict[str, Value]]:
        """Measured values of all regions in ``entries``, one dictionary per region, for ``pandas.DataFrame``."""
        return [dict(zip(KEYS, row, strict=True)) for entry in self.entries for row in entry.rows()]

    @property
    def exit_status(self) -> int:
        """Exit status of the command: 3 if a shot exceeds a limit, else 2 if a shot was not read, else 0."""
        if self.counts["beyond"]:
            return 3
        return 2 if self.counts["unread"] or self.waiting or self.trouble else 0


class ChangedWhileRead(PolarguideError):
    """Error for a file that changed while it was read."""


class Line(contextlib.AbstractContextManager["Line"]):
    """A ``Measurer`` that writes its results to a table. The context manager closes the table.

    Args:
        out: folder of the table.
        options: quantities to measure, and their limits.
        reading: options of reading.

    Raises:
        PolarguideError: an option, the limits, the reference or the table are invalid.
    """

    def __init__(self, out: Path, options: MeasureOptions, reading: ShotOptions) -> None:
        self.measurer = Measurer(options, reading)
        self.out = out
        require_inside(out, out / BEYOND, out / DIFFERENCES)
        self.table = Table(
            out, self.measurer.settings(), overwrite=options.overwrite, judge=self.measurer.judge
        )

    def __exit__(self, *_: object) -> None:
        self.table.close()

    def measure(self, shot: ExposureSet, files: tuple[FileStamp, ...]) -> Entry:
        """Measure a shot, draw its pictures, and write its line to the table.

        Args:
            shot: the shot.
            files: ``stamps`` of its files.

        Raises:
            ChangedWhileRead: a file has changed. Nothing was written.
            PolarguideError, OSError, MemoryError: the shot cannot be read, or does not fit the regions or the
                reference.
        """
        maps = self.measurer.read(shot)
        if stamps(shot.paths) != files:
            raise ChangedWhileRead(
                shot.where,
                expected="a file that does not change while it is read",
                found="a file that was written to",
                remedy="Repeat the command when the file is complete, or use --watch, which waits for complete files.",
            )
        measured = self.measurer.measured(shot, maps)
        # A line in the table implies that its pictures exist.
        return self.table.add(measured.entry(files, self._draw(shot, measured)))

    def unread(self, shot: ExposureSet, files: tuple[FileStamp, ...], error: BaseException) -> Entry:
        """Write the line of a shot that cannot be measured, and return it."""
        return self.table.add(unread_entry(shot, files, error))

    def _draw(self, shot: ExposureSet, measured: MeasuredShot) -> str:
        """Write the pictures of a shot, and return the name of the files, which is empty without pictures."""
        reference = self.measurer.reference
        if not measured.beyond and reference is None:
            return ""
        name = self.table.picture_name(measured.maps.name)
        if measured.beyond:
            self._draw_beyond(shot, measured, name)
        if measured.differences is not None and reference is not None:
            picture = difference_picture(measured.differences, measured.maps.name, reference.name)
            make_folder(self.out / DIFFERENCES)
            write_png(self.out / DIFFERENCES / f"{name}.png", picture)
        return name

    def _draw_beyond(self, shot: ExposureSet, measured: MeasuredShot, name: str) -> None:
        maps = measured.maps if measured.maps.whole is None else self.measurer.read(shot, whole=True)
        picture = regions_picture(maps, measured.beyond, self.measurer.limits, measured.differences)
        make_folder(self.out / BEYOND)
        write_png(self.out / BEYOND / f"{name}.png", picture)

    def follow_judgment(self, shot: ExposureSet, entry: Entry) -> None:
        """Draw or remove the picture of a shot whose status was updated because the limits changed.

        Raises:
            PolarguideError, OSError, MemoryError: the shot cannot be read, or the picture cannot be written.
        """
        if entry.status == "beyond":
            self._draw_beyond(shot, self.measurer.measured(shot, self.measurer.read(shot)), entry.picture)
        elif entry.picture:
            (self.out / BEYOND / f"{entry.picture}.png").unlink(missing_ok=True)


Source = PathLike | ExposureSet | Array | Sequence[Array]
"""Input of ``measure_shots``: a file, a folder, a result of ``find_shots``, or the array of one shot."""


def measure_shots(
    paths: Iterable[Source] | Mapping[str, Array],
    out: PathLike | None = None,
    options: MeasureOptions = MeasureOptions(),
    reading: ShotOptions = ShotOptions(),
    *,
    angles: Sequence[Angle] = ANGLES,
    heard: Heard = ignore,
    reporter: Reporter = SILENT,
) -> Outcome:
    """Measure shots, and optionally write the results to a table. Shots that are in the table are skipped.

    Args:
        paths: files and folders (see ``find_shots``), or one array for each shot (see ``read_shot``). Arrays in a
            mapping are named by its keys, other arrays array-1, array-2, ... An iterator of arrays is consumed one by
            one.
        out: folder of ``table.csv``, ``table.jsonl`` and pictures. If None, no table is written.
        options: quantities to measure, and their limits.
        reading: options of reading.
        angles: angles of arrays with pictures through a filter.
        heard: callback for each shot. It is called after the line is on disk, or without a table after the measurement.
        reporter: receiver of progress and messages.

    Returns:
        The result. Without a table, its attributes ``entries`` and ``rows`` contain the measured values.

    Example:
        >>> regions = polarguide.MeasureOptions(roi=("pin=120,80,40,40",))              # doctest: +SKIP
        >>> sensor = polarguide.ShotOptions(sensor="IMX250MZR")                         # doctest: +SKIP
        >>> polarguide.measure([frame], options=regions, reading=sensor).rows[0]["dolp_mean"]   # doctest: +SKIP
        0.213

    Raises:
        PolarguideError: there is no shot, an option is invalid, an array is not a shot, or the table cannot be written.
            A shot that cannot be read does not raise an error; its line contains the reason.
    """
    shots, total = _shots_of(paths, out, reading, angles)
    counts: Counter[str] = Counter()
    entries: list[Entry] = []
    earlier = 0
    with contextlib.ExitStack() as stack:
        line = stack.enter_context(Line(Path(out), options, reading)) if out is not None else None
        measurer = line.measurer if line is not None else Measurer(options, reading)
        if line is not None and line.table.judged_again:
            reporter.say(
                f"{out}: {line.table.judged_again} shots compared with new limits; their figures are kept"
            )
        advance = stack.enter_context(reporter.track("measure", total))
        for number, shot in enumerate(shots, 1):
            if line is None:
                entry = measurer.entry(shot)
                entries.append(entry)
                heard(entry)
            else:
                known, entry = _measure_into(line, shot, heard)
                earlier += known
            counts[entry.status] += 1
            advance(number)
        if line is not None:
            line.table.require_present()
    return Outcome(None if out is None else Path(out), counts, earlier, entries=tuple(entries))


def _measure_into(line: Line, shot: ExposureSet, heard: Heard) -> tuple[bool, Entry]:
    """Measure a shot unless it is in the table already.

    Returns:
        True if the shot was in the table; and its line.
    """
    files: tuple[FileStamp, ...] = ()
    with contextlib.suppress(OSError):
        files = stamps(shot.paths)
    known = line.table.entry_of(files) if files else None
    if known is not None:
        if line.table.judged_again:
            with contextlib.suppress(*UNREADABLE):  # a missing picture must not prevent the line
                line.follow_judgment(shot, known)
            if known.status == "beyond":
                heard(known)
        return True, known
    try:
        entry = line.measure(shot, files)
    except UNREADABLE as error:
        entry = line.unread(shot, files, error)
    heard(entry)
    return False, entry


def _shots_of(
    paths: Iterable[Source] | Mapping[str, Array],
    out: PathLike | None,
    reading: ShotOptions,
    angles: Sequence[Angle],
) -> tuple[Iterable[ExposureSet], int | None]:
    """Return the shots to measure, and their number. An iterator has no number, which gives None.

    Raises:
        PolarguideError: there is no shot, or an array is not a shot.
    """
    if isinstance(paths, Mapping):
        named = [array_shot(stacked_array(a, name), reading, angles, name) for name, a in paths.items()]
        return named, len(named)
    require(
        isinstance(paths, list | tuple) or not is_array(paths),
        "paths",
        expected="several shots",
        found="one array",
        remedy="Put the array into a list: measure([array]).",
    )
    if not isinstance(paths, Sequence):
        return (_array_set(shot, number, reading, angles) for number, shot in enumerate(paths, 1)), None
    if paths and all(isinstance(shot, ExposureSet) or is_array(shot) for shot in paths):
        return [_array_set(shot, number, reading, angles) for number, shot in enumerate(paths, 1)], len(paths)
    files = [path for path in paths if isinstance(path, str | os.PathLike)]
    require(
        len(files) == len(paths),
        "paths",
        expected="files, or arrays",
        found="both, or neither",
        remedy="Measure files and arrays in separate calls.",
    )
    if out is not None:
        require_elsewhere(files, Path(out))
    shots = find_shots(files, reading)
    return shots, len(shots)


def _array_set(shot: Source, number: int, reading: ShotOptions, angles: Sequence[Angle]) -> ExposureSet:
    """Convert an array to an ``ExposureSet``. An ``ExposureSet`` is returned unchanged.

    Raises:
        PolarguideError: the array is not a shot.
    """
    if isinstance(shot, ExposureSet):
        return shot
    name = f"{NAME}-{number}"
    if not is_array(shot):
        raise PolarguideError(
            name,
            expected="an array",
            found=type(shot).__name__,
            remedy="An iterator must yield arrays. Specify paths as a list.",
        )
    return array_shot(stacked_array(shot, name), reading, angles, name)


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
