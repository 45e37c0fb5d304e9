"""Measure shots, one after the other, into a table."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, require_inside
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.shots.develop import check_files
from polarguide.shots.exposures import ExposureSet, find_shots, require_elsewhere
from polarguide.shots.maps import ShotMaps
from polarguide.shots.measurement.fields import FORMAT, NO_LIMITS, Value, faults, read_limits
from polarguide.shots.measurement.options import MeasureOptions
from polarguide.shots.measurement.pictures import difference_picture, regions_picture
from polarguide.shots.measurement.regions import (
    WHOLE,
    Differences,
    Reference,
    Region,
    difference_figures,
    parse_regions,
    placed,
    region_figures,
)
from polarguide.shots.measurement.table import Entry, FileStamp, Status, Table, stamps
from polarguide.shots.options import ShotOptions
from polarguide.shots.read import UNREADABLE, fault_of, read_shot
from polarguide.visualization.figures import write_png

BEYOND, DIFFERENCES = "beyond", "differences"
"""Folders of pictures beside the table."""
Heard = Callable[[Entry], None]


def ignore(entry: Entry) -> None:
    """Hear nothing."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a command has done.

    Attributes:
        folder: of the table.
        counts: shots by status. Of ``measure_shots`` these are all it was given, those included that were in the table
            before; of ``watch_folder`` those that came while it watched.
        earlier: how many were in the table before; 0 of ``watch_folder``.
        waiting: shots of a watched folder that were not complete when it stopped.
        trouble: why no shot was found in a watched folder in the end, though it is not empty; else "".
    """

    folder: Path
    counts: Counter[str]
    earlier: int = 0
    waiting: tuple[str, ...] = ()
    trouble: str = ""

    @property
    def exit_status(self) -> int:
        """3 if a shot is beyond a limit, else 2 if one was not read, else 0."""
        if self.counts["beyond"]:
            return 3
        return 2 if self.counts["unread"] or self.waiting or self.trouble else 0


class ChangedWhileRead(PolarguideError):
    """A file was written to while it was read."""


class Line:
    """Everything that stays the same from shot to shot. Use it as a context: it holds the table open."""

    def __init__(self, out: Path, options: MeasureOptions, reading: ShotOptions) -> None:
        """Check the options, read limits and reference, open the table.

        Raises:
            PolarguideError: one of them is wrong.
        """
        self._reading = reading.checked()
        check_files(self._reading)
        self._options = options
        self._regions = parse_regions(options.roi)
        names = [region.name for region in self._regions] or [WHOLE]
        self._limits = NO_LIMITS
        if options.limits is not None:
            self._limits = read_limits(options.limits, names, reference=options.reference is not None)
        self._reference = None
        if options.reference is not None:
            self._reference = Reference.read(options.reference, self._reading)
            placed(self._regions, self._reference.size, options.reference)
        self.out = out
        require_inside(out, out / BEYOND, out / DIFFERENCES)
        self.table = Table(out, self._settings(), overwrite=options.overwrite)

    def __enter__(self) -> Line:
        return self

    def __exit__(self, *_: object) -> None:
        self.table.close()

    @property
    def reference_files(self) -> tuple[Path, ...]:
        """Files that are compared with, and not measured where they lie in a watched folder."""
        return () if self._reference is None else self._reference.shot.paths

    def measure(self, shot: ExposureSet, files: tuple[FileStamp, ...]) -> Entry:
        """Measure a shot, draw what is to be drawn, and write its line.

        Args:
            shot: the shot. files: ``stamps`` of its files.

        Raises:
            ChangedWhileRead: they have become others meanwhile; nothing was written.
            PolarguideError, OSError, MemoryError: it cannot be read, or does not fit the regions or the reference.
        """
        maps = read_shot(shot, self._reading)
        if stamps(shot.paths) != files:
            raise ChangedWhileRead(
                shot.paths[0],
                expected="a file that stays as it is",
                found="that it was written to meanwhile",
                remedy="Repeat the command when it is complete; --watch waits for that.",
            )
        regions = placed(self._regions, maps.size, shot.paths[0])
        differences = None if self._reference is None else self._reference.differences(maps)
        found = [self._region(maps, region, differences) for region in regions]
        statuses = [str(figures["status"]) for _, figures, _ in found]
        status: Status = (
            "beyond" if "beyond" in statuses else "within" if "within" in statuses else "measured"
        )
        beyond = [(region, which) for region, _, which in found] if status == "beyond" else []
        picture = self._draw(maps, differences, beyond)
        measured = tuple(figures for _, figures, _ in found)
        entry = Entry(FORMAT, shot.name, files, status, "", maps.notes, measured, picture)
        self.table.add(entry)
        return entry

    def unread(self, shot: ExposureSet, files: tuple[FileStamp, ...], error: BaseException) -> Entry:
        """Write the line of a shot that cannot be measured."""
        entry = Entry(FORMAT, shot.name, files, "unread", str(fault_of(shot, error)), (), ())
        self.table.add(entry)
        return entry

    def _region(
        self, maps: ShotMaps, region: Region, differences: Differences | None
    ) -> tuple[Region, dict[str, Value], list[str]]:
        figures = {
            **region_figures(maps, region, self._options.threshold),
            **difference_figures(differences, region),
        }
        bounds = self._limits.of(region.name)
        beyond = faults(figures, bounds)
        status = "beyond" if beyond else "within" if bounds else "measured"
        head: dict[str, Value] = {
            "region": region.name,
            "x": region.x,
            "y": region.y,
            "width": region.width,
            "height": region.height,
            "status": status,
            "why": ", ".join(beyond),
        }
        return region, {**head, **figures}, beyond

    def _draw(
        self,
        maps: ShotMaps,
        differences: Differences | None,
        beyond: Sequence[tuple[Region, Sequence[str]]],
    ) -> str:
        """Write pictures before the line of the table: where that is, they are. Their name, "" if there are none."""
        if not beyond and differences is None:
            return ""
        name = self.table.picture_name(maps.name)
        if beyond:
            make_folder(self.out / BEYOND)
            write_png(self.out / BEYOND / f"{name}.png", regions_picture(maps, beyond))
        if differences is not None and self._reference is not None:
            make_folder(self.out / DIFFERENCES)
            picture = difference_picture(differences, maps.name, self._reference.name)
            write_png(self.out / DIFFERENCES / f"{name}.png", picture)
        return name

    def _settings(self) -> dict[str, Any]:
        """What the figures depend on, as JSON."""
        reading = {f.name: getattr(self._reading, f.name) for f in dataclasses.fields(self._reading)}
        named = [value for value in reading.values() if isinstance(value, Path)]
        made: dict[str, Any] = msgspec.to_builtins(
            {
                "reading": reading,
                "read_files": stamps(tuple(named)),
                "regions": self._regions,
                "threshold": self._options.threshold,
                "limits": self._limits,
                "reference": stamps(self.reference_files),
            },
            enc_hook=str,
        )
        return made


def measure_shots(
    paths: Sequence[PathLike],
    out: PathLike,
    options: MeasureOptions = MeasureOptions(),
    reading: ShotOptions = ShotOptions(),
    *,
    heard: Heard = ignore,
    reporter: Reporter = SILENT,
) -> Outcome:
    """Measure shots into the table of a folder; those that are in it already are not measured again.

    Args:
        paths: files and folders, as ``shots.exposures.find_shots`` takes them.
        out: folder of ``table.csv``, ``table.jsonl`` and pictures.
        options: what is measured. reading: how shots are read.
        heard: is called with each shot when its line is on disk.
        reporter: takes progress.

    Raises:
        PolarguideError: there is no shot, an option is wrong, or the table cannot be written. A shot that cannot be
            read raises nothing: its line says why.
    """
    require_elsewhere(paths, Path(out))
    shots = find_shots(paths, reading)
    counts: Counter[str] = Counter()
    earlier = 0
    with Line(Path(out), options, reading) as line, reporter.track("measure", len(shots)) as advance:
        for number, shot in enumerate(shots, 1):
            files: tuple[FileStamp, ...] = ()
            with contextlib.suppress(OSError):
                files = stamps(shot.paths)
            status = line.table.status_of(files) if files else None
            if status is not None:
                earlier += 1
            else:
                try:
                    entry = line.measure(shot, files)
                except UNREADABLE as error:
                    entry = line.unread(shot, files, error)
                status = entry.status
                heard(entry)
            counts[status] += 1
            advance(number)
        line.table.require_there()
    return Outcome(Path(out), counts, earlier)
