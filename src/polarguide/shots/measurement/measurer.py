"""Measure one shot after the other, without a file: what regions, limits and the reference make of its maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from polarguide.shots.develop import check_files
from polarguide.shots.exposures import ExposureSet
from polarguide.shots.maps import ShotMaps
from polarguide.shots.measurement.fields import FORMAT, NO_LIMITS, Value, faults, read_limits
from polarguide.shots.measurement.options import MeasureOptions
from polarguide.shots.measurement.regions import (
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
from polarguide.shots.measurement.table import Entry, FileStamp, Status, stamps
from polarguide.shots.options import ShotOptions
from polarguide.shots.read import UNREADABLE, fault_of, read_shot


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """A shot that was measured.

    Attributes:
        maps: of it. differences: to the reference, None without one.
        regions: by ``Field.key``, from ``region`` on. status: the worst of them.
        beyond: all regions with the limits that they are beyond; empty where none is.
    """

    maps: ShotMaps
    differences: Differences | None
    regions: tuple[dict[str, Value], ...]
    status: Status
    beyond: Sequence[tuple[Region, Sequence[str]]]

    def entry(self, files: tuple[FileStamp, ...] = (), picture: str = "") -> Entry:
        """Its line of the table."""
        maps = self.maps
        return Entry(FORMAT, maps.name, files, self.status, "", maps.notes, self.regions, picture)


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
        self._limits = NO_LIMITS
        if options.limits is not None:
            self._limits = read_limits(options.limits, names, reference=options.reference is not None)
        self._reference = None
        if options.reference is not None:
            self._reference = Reference.read(options.reference, self._reading)
            placed(self._regions, self._reference.size, options.reference)
        self._part = None if self._reference is not None else box_of(self._regions)

    @property
    def reference_files(self) -> tuple[Path, ...]:
        """Files of the reference."""
        return () if self._reference is None else self._reference.shot.paths

    @property
    def reference_name(self) -> str:
        """Its name; empty without one."""
        return "" if self._reference is None else self._reference.name

    def read(self, shot: ExposureSet, *, whole: bool = False) -> ShotMaps:
        """The maps of a shot: of all of it where ``whole``, or where it is compared with a reference; else at least of
        the regions.

        Raises:
            PolarguideError, OSError, MemoryError: it cannot be read.
        """
        return read_shot(shot, self._reading, part=None if whole else self._part)

    def measured(self, shot: ExposureSet, maps: ShotMaps) -> Measured:
        """What its maps say.

        Raises:
            PolarguideError: it does not fit the regions or the reference.
        """
        regions = placed(self._regions, maps.whole or maps.size, shot.where)
        differences = None if self._reference is None else self._reference.differences(maps)
        found = [self._region(maps, region, differences) for region in regions]
        statuses = [str(figures["status"]) for _, figures, _ in found]
        status: Status = (
            "beyond" if "beyond" in statuses else "within" if "within" in statuses else "measured"
        )
        beyond = [(region, which) for region, _, which in found] if status == "beyond" else []
        return Measured(maps, differences, tuple(figures for _, figures, _ in found), status, beyond)

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

    def settings(self) -> dict[str, Any]:
        """What the figures depend on, as JSON."""
        reading = {f.name: getattr(self._reading, f.name) for f in dataclasses.fields(self._reading)}
        named = [value for value in reading.values() if isinstance(value, Path)]
        made: dict[str, Any] = msgspec.to_builtins(
            {
                "reading": reading,
                "read_files": stamps(tuple(named)),
                "regions": [
                    {
                        name: value
                        for name, value in dataclasses.asdict(region).items()
                        if name != "corners" or value
                    }
                    for region in self._regions
                ],
                "threshold": self._options.threshold,
                "limits": self._limits,
                "reference": stamps(self.reference_files),
            },
            enc_hook=str,
        )
        return made


def unread_entry(shot: ExposureSet, files: tuple[FileStamp, ...], error: BaseException) -> Entry:
    """The line of a shot that cannot be measured.

    Args:
        shot: the shot. files: ``stamps`` of its files. error: why, one of ``UNREADABLE``.
    """
    return Entry(FORMAT, shot.name, files, "unread", str(fault_of(shot, error)), (), ())
