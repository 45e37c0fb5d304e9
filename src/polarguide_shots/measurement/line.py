"""Measure shots, one after the other: what regions, limits and a reference make of their maps, into a table or none."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from polarguide.capture.exposures import Angle
from polarguide.capture.view import ANGLES
from polarguide.capture.view_reader import Array
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, require_inside
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.visualization.figures import write_png
from polarguide_shots.exposures import find_shots, require_elsewhere
from polarguide_shots.maps import ShotMaps
from polarguide_shots.measurement.fields import (
    FORMAT,
    KEYS,
    NO_LIMITS,
    Status,
    Value,
    faults,
    read_limits,
    verdict,
    worst,
)
from polarguide_shots.measurement.pictures import difference_picture, regions_picture
from polarguide_shots.measurement.regions import (
    WHOLE,
    Differences,
    Reference,
    Region,
    box_of,
    difference_figures,
    parse_regions,
    placed,
    region_figures,
)
from polarguide_shots.measurement.table import Entry, FileStamp, Table, stamps
from polarguide_shots.options import MeasureOptions, ShotOptions
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
    """A shot that was measured.

    Attributes:
        maps: of it. differences: to the reference, None without one.
        regions: by ``Field.key``, from ``region`` on. status: the worst of them.
        beyond: all regions with the limits that they are beyond; empty if all regions are within.
    """

    maps: ShotMaps
    differences: Differences | None
    regions: tuple[dict[str, Value], ...]
    status: Status
    beyond: Sequence[tuple[Region, Sequence[str]]]

    def entry(self, files: tuple[FileStamp, ...] = (), picture: str = "") -> Entry:
        """Its line of the table."""
        return Entry(FORMAT, self.maps.name, files, self.status, "", self.maps.notes, self.regions, picture)


class Measurer:
    """Everything that stays the same from shot to shot."""

    def __init__(self, options: MeasureOptions, reading: ShotOptions) -> None:
        """Check the options, read limits and reference.

        Raises:
            PolarguideError: one of them is wrong.
        """
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
            self.reference = Reference.read(options.reference, self._reading)
            placed(self._regions, self.reference.size, options.reference)
        self._part = None if self.reference is not None else box_of(self._regions)

    @property
    def reference_files(self) -> tuple[Path, ...]:
        """Files that are compared with, and not measured where they lie in a watched folder."""
        return () if self.reference is None else self.reference.shot.paths

    def read(self, shot: ExposureSet, *, whole: bool = False) -> ShotMaps:
        """The maps of a shot: of the whole picture if ``whole`` or with a reference, else at least of the regions.

        Raises:
            PolarguideError, OSError, MemoryError: the shot cannot be read.
        """
        return read_shot(shot, self._reading, part=None if whole else self._part)

    def measured(self, shot: ExposureSet, maps: ShotMaps) -> MeasuredShot:
        """The figures of its maps.

        Raises:
            PolarguideError: the shot does not fit the regions or the reference.
        """
        regions = placed(self._regions, maps.whole or maps.size, shot.where)
        differences = None if self.reference is None else self.reference.differences(maps)
        measured = [self._region(maps, region, differences) for region in regions]
        status = worst([figures for _, figures, _ in measured])
        beyond = [(region, which) for region, _, which in measured] if status == "beyond" else []
        return MeasuredShot(maps, differences, tuple(figures for _, figures, _ in measured), status, beyond)

    def entry(self, shot: ExposureSet) -> Entry:
        """The line of a shot, which says why where it cannot be measured."""
        try:
            return self.measured(shot, self.read(shot)).entry()
        except UNREADABLE as error:
            return unread_entry(shot, (), error)

    def _region(
        self, maps: ShotMaps, region: Region, differences: Differences | None
    ) -> tuple[Region, dict[str, Value], list[str]]:
        local = dataclasses.replace(region, x=region.x - maps.origin[0], y=region.y - maps.origin[1])
        figures = {
            **region_figures(maps, local, self._options.threshold),
            **difference_figures(differences, local),
        }
        bounds = self.limits.of(region.name)
        beyond = faults(figures, bounds)
        head: dict[str, Value] = {
            "region": region.name,
            "x": region.x,
            "y": region.y,
            "width": region.width,
            "height": region.height,
        }
        return region, {**head, **verdict(beyond, bounds), **figures}, beyond

    def judged(self, entry: Entry) -> Entry:
        """A line of a table by the limits; its figures do not change."""
        regions = []
        for figures in entry.regions:
            bounds = self.limits.of(str(figures["region"]))
            regions.append({**figures, **verdict(faults(figures, bounds), bounds)})
        status = worst(regions) if regions else entry.status
        return msgspec.structs.replace(entry, status=status, regions=tuple(regions))

    def settings(self) -> dict[str, Any]:
        """The settings that the figures depend on, as JSON."""
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
    """The line of a shot that cannot be measured.

    Args:
        shot: the shot. files: ``stamps`` of its files. error: why, one of ``UNREADABLE``.
    """
    return Entry(FORMAT, shot.name, files, "unread", str(fault_of(shot, error)), (), ())


BEYOND = "beyond"
"""Folder of pictures of shots beyond their limits."""
DIFFERENCES = "differences"
"""Folder of pictures of differences."""
Heard = Callable[[Entry], None]


def ignore(entry: Entry) -> None:
    """Hear nothing."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The outcome of a command.

    Attributes:
        folder: folder of the table; None where nothing was written.
        counts: shots by status. Of ``measure_shots`` these are all it was given, those included that were in the table
            before; of ``watch_folder`` those that came while it watched.
        earlier: how many were in the table before; 0 of ``watch_folder``.
        waiting: shots of a watched folder that were not complete when it stopped.
        trouble: why no shot was found in a watched folder in the end, though it is not empty; else "".
        entries: lines of the table, where nothing was written.
    """

    folder: Path | None
    counts: Counter[str]
    earlier: int = 0
    waiting: tuple[str, ...] = ()
    trouble: str = ""
    entries: tuple[Entry, ...] = ()

    @property
    def rows(self) -> list[dict[str, Value]]:
        """The ``entries`` as records, one a region, with the fields of the table; ``pandas.DataFrame`` takes them."""
        return [dict(zip(KEYS, row, strict=True)) for entry in self.entries for row in entry.rows()]

    @property
    def exit_status(self) -> int:
        """3 if a shot is beyond a limit, else 2 if one was not read, else 0."""
        if self.counts["beyond"]:
            return 3
        return 2 if self.counts["unread"] or self.waiting or self.trouble else 0


class ChangedWhileRead(PolarguideError):
    """A file was written to while it was read."""


class Line(contextlib.AbstractContextManager["Line"]):
    """A ``Measurer`` and the table that it writes into. Use it as a context: it holds the table open."""

    def __init__(self, out: Path, options: MeasureOptions, reading: ShotOptions) -> None:
        """Check the options, read limits and reference, open the table.

        Raises:
            PolarguideError: one of them is wrong.
        """
        self.measurer = Measurer(options, reading)
        self.out = out
        require_inside(out, out / BEYOND, out / DIFFERENCES)
        self.table = Table(
            out, self.measurer.settings(), overwrite=options.overwrite, judged=self.measurer.judged
        )

    def __exit__(self, *_: object) -> None:
        self.table.close()

    def measure(self, shot: ExposureSet, files: tuple[FileStamp, ...]) -> Entry:
        """Measure a shot, draw what is to be drawn, and write its line.

        Args:
            shot: the shot. files: ``stamps`` of its files.

        Raises:
            ChangedWhileRead: they have become others meanwhile; nothing was written.
            PolarguideError, OSError, MemoryError: the shot cannot be read, or does not fit regions or reference.
        """
        maps = self.measurer.read(shot)
        if stamps(shot.paths) != files:
            raise ChangedWhileRead(
                shot.where,
                expected="a file that does not change while it is read",
                found="a file that was written to",
                remedy="Repeat the command when it is complete; --watch waits for that.",
            )
        measured = self.measurer.measured(shot, maps)
        entry = measured.entry(files, self._draw(shot, measured))
        self.table.add(entry)
        return entry

    def unread(self, shot: ExposureSet, files: tuple[FileStamp, ...], error: BaseException) -> Entry:
        """Write the line of a shot that cannot be measured."""
        entry = unread_entry(shot, files, error)
        self.table.add(entry)
        return entry

    def _draw(self, shot: ExposureSet, measured: MeasuredShot) -> str:
        """Write pictures before the line of the table: where that is, they are. Their name, "" if there are none."""
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
        """Draw the picture of a shot that other limits than before call beyond, or remove that of one within.

        Raises:
            PolarguideError, OSError, MemoryError: the shot cannot be read again, or the picture not written.
        """
        if entry.status == "beyond":
            measured = self.measurer.measured(shot, self.measurer.read(shot))
            self._draw_beyond(shot, measured, entry.picture)
        elif entry.picture:
            (self.out / BEYOND / f"{entry.picture}.png").unlink(missing_ok=True)


Source = PathLike | ExposureSet | Array | Sequence[Array]
"""What a shot is measured of: files or folders, or the array of one shot as ``read_shot`` takes it."""


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
    """Measure shots: into the table of a folder, where those that are in it already are not measured again, or without
    any file.

    Args:
        paths: files and folders, as ``shots.exposures.find_shots`` takes them; or shots in memory, one array each, as
            ``read_shot`` takes them, called array-1, array-2, ... or by their names in a mapping. An iterator of arrays
            is measured as it delivers them.
        out: folder of ``table.csv``, ``table.jsonl`` and pictures; None: nothing is written.
        options: what is measured. reading: how shots are read. angles: of arrays that are pictures through a filter.
        heard: is called with each shot when its line is on disk, or without a folder when it is measured.
        reporter: takes progress.

    Returns:
        What was done; without a folder, its ``entries`` are the lines of the table, and ``rows`` the same as records.

    Example:
        >>> regions = polarguide.MeasureOptions(roi=("pin=120,80,40,40",))              # doctest: +SKIP
        >>> sensor = polarguide.ShotOptions(sensor="IMX250MZR")                         # doctest: +SKIP
        >>> polarguide.measure([frame], options=regions, reading=sensor).rows[0]["dolp_mean"]   # doctest: +SKIP
        0.213

    Raises:
        PolarguideError: there is no shot, an option is wrong, an array is no shot, or the table cannot be
            written. A shot that cannot be read raises nothing: its line says why.
    """
    shots, total = _shots_of(paths, out, reading, angles)
    counts: Counter[str] = Counter()
    entries: list[Entry] = []
    earlier = 0
    with contextlib.ExitStack() as stack:
        line = stack.enter_context(Line(Path(out), options, reading)) if out is not None else None
        measurer = line.measurer if line is not None else Measurer(options, reading)
        if line is not None and line.table.judged_again:
            reporter.say(f"{out}: {line.table.judged_again} shots judged by other limits; their figures stay")
        advance = stack.enter_context(reporter.track("measure", total))
        for number, shot in enumerate(shots, 1):
            if line is None:
                entry = measurer.entry(shot)
                entries.append(entry)
                heard(entry)
            else:
                known, entry = _measured_into(line, shot, heard)
                earlier += known
            counts[entry.status] += 1
            advance(number)
        if line is not None:
            line.table.require_there()
    return Outcome(None if out is None else Path(out), counts, earlier, entries=tuple(entries))


def _measured_into(line: Line, shot: ExposureSet, heard: Heard) -> tuple[bool, Entry]:
    """Measure a shot into a table that does not have it; whether it had, and the line."""
    files: tuple[FileStamp, ...] = ()
    with contextlib.suppress(OSError):
        files = stamps(shot.paths)
    known = line.table.entry_of(files) if files else None
    if known is not None:
        if line.table.judged_again:
            with contextlib.suppress(*UNREADABLE):  # its line is there; only the picture is not
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
    """The shots, and how many there are where that is known."""
    if isinstance(paths, Mapping):
        named = [array_shot(stacked_array(a, name), reading, angles, name) for name, a in paths.items()]
        return named, len(named)
    if is_array(paths) and not isinstance(paths, list | tuple):
        raise PolarguideError(
            "paths",
            expected="several shots",
            found="one array",
            remedy="Put it into a list: measure([array]).",
        )
    if not isinstance(paths, Sequence):
        return (_array_set(shot, number, reading, angles) for number, shot in enumerate(paths, 1)), None
    if paths and all(isinstance(shot, ExposureSet) or is_array(shot) for shot in paths):
        return [_array_set(shot, number, reading, angles) for number, shot in enumerate(paths, 1)], len(paths)
    files = [path for path in paths if isinstance(path, str | os.PathLike)]
    if len(files) < len(paths):
        raise PolarguideError(
            "paths",
            expected="files, or arrays",
            found="both, or neither",
            remedy="Measure files and arrays by calls of their own.",
        )
    if out is not None:
        require_elsewhere(files, Path(out))
    shots = find_shots(files, reading)
    return shots, len(shots)


def _array_set(shot: Source, number: int, reading: ShotOptions, angles: Sequence[Angle]) -> ExposureSet:
    if isinstance(shot, ExposureSet):
        return shot
    name = f"{NAME}-{number}"
    if not is_array(shot):
        raise PolarguideError(
            name,
            expected="an array",
            found=type(shot).__name__,
            remedy="An iterator delivers arrays; give paths as a list.",
        )
    return array_shot(stacked_array(shot, name), reading, angles, name)
