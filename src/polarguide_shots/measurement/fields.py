"""The fields of the table, and the limits that a file sets to them."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.records import read_record

FORMAT = 2
"""Version of the table. It grows whenever a field changes its name, place or meaning, or is added."""
PERCENTILES = (1, 5, 50, 95, 99)
DIFFERENCE_PERCENTILE = 99
Value = int | float | str | None

Status = Literal["measured", "within", "beyond", "unread"]


@dataclass(frozen=True)
class Field:
    """One field.

    Attributes:
        key: its name.
        unit: unit of its numbers; empty where it has none.
        about: what it says.
        bounded: whether a limits file may bound it.
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
    Field("files", "", "paths of its files, separated by semicolons", False),
    Field("taken", "", "when the last of its files was written, UTC; empty of a shot without files", False),
    Field("region", "", "name of the region; empty where the shot could not be read", False),
    Field("x", "pixels", "left column of the region", False),
    Field("y", "pixels", "top row of the region", False),
    Field("width", "pixels", "of the region", False),
    Field("height", "pixels", "of the region", False),
    Field("status", "", "measured (nothing bounds it), within, beyond (a limit), or unread", False),
    Field("why", "", "the limits that it is beyond, or why the shot could not be read", False),
    Field("pixels", "pixels", "in the region"),
    Field("usable", "pixels", "that have an angle: no reason against them"),
    Field("noise", "pixels", "whose DoLP is not above its noise"),
    Field("dark", "pixels", "without light to be told from the noise"),
    Field("saturated", "pixels", "made from a sample at full scale"),
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
"""In the order of the columns. Without a value (no pixel for it, no reference) a cell is empty, in JSON null."""
KEYS = tuple(field.key for field in FIELDS)
BOUNDED = tuple(field.key for field in FIELDS if field.bounded)
COMPARED = KEYS[KEYS.index("compared") :]
"""Those that need a reference."""
AXIAL = ("aolp_mean",)
"""Those that go round: 180 degrees are 0."""


_REMEDY = "Correct the file."


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Smallest and largest allowed value, both allowed themselves; None: none."""

    min: float | None = None
    max: float | None = None


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The limits of a file.

    Attributes:
        format: 1.
        limits: by field, for every region.
        regions: by region, then by field; they take the place of those in ``limits``.
    """

    format: int = 1
    limits: dict[str, Bound] = {}
    regions: dict[str, dict[str, Bound]] = {}

    def of(self, region: str) -> dict[str, Bound]:
        """The bounds of a region, by field."""
        return {**self.limits, **self.regions.get(region, {})}


NO_LIMITS = Limits()


def read_limits(path: Path, regions: Collection[str], *, reference: bool) -> Limits:
    """Read a limits file.

    Args:
        path: JSON: ``{"limits": {field: {"min": a, "max": b}}, "regions": {region: {field: ...}}}``.
        regions: names that may occur in it. reference: whether shots are compared with one.

    Raises:
        PolarguideError: the file cannot be read, names an unknown field or region, or bounds nothing.
    """
    limits = read_record(path, Limits, remedy=_REMEDY)
    if limits.format != 1:
        raise _wrong(path, "format", "1", str(limits.format))
    places = {"limits": limits.limits}
    for region, bounds in limits.regions.items():
        if region not in regions:
            raise _wrong(path, "regions", f"a region of --roi: {', '.join(regions)}", region)
        places[f"regions.{region}"] = bounds
    for place, bounds in places.items():
        for field, bound in bounds.items():
            _check(path, f"{place}.{field}", field, bound, reference)
    if not any(places.values()):
        raise _wrong(path, "limits", "a bound of at least one field", "none")
    return limits


def _check(path: Path, place: str, field: str, bound: Bound, reference: bool) -> None:
    if field not in BOUNDED:
        near = difflib.get_close_matches(field, BOUNDED, 3, 0.5)
        raise _wrong(path, place, "a field of the table", field, near)
    if field in COMPARED and not reference:
        raise PolarguideError(
            f"{path} ({place})",
            expected="a golden part, because this field limits the difference from it",
            found="none",
            remedy="Give the golden part with --reference, or remove the field.",
        )
    if bound.min is None and bound.max is None:
        raise _wrong(path, place, "min, max or both", "neither")
    for value in (bound.min, bound.max):
        if field in AXIAL and value is not None and not 0 <= value <= 180:
            raise _wrong(path, place, "angles from 0 to 180", f"{value:g}")
    if bound.min is not None and bound.max is not None and bound.min > bound.max and field not in AXIAL:
        raise _wrong(path, place, "a min up to the max", f"{bound.min:g} and {bound.max:g}")


def _wrong(
    path: Path, place: str, expected: str, found: str, near: list[str] | None = None
) -> PolarguideError:
    hint = f"Perhaps {' or '.join(near)} is meant." if near else _REMEDY
    return PolarguideError(f"{path} ({place})", expected=expected, found=found, remedy=hint)


def faults(figures: Mapping[str, Value], bounds: Mapping[str, Bound]) -> list[str]:
    """Which figures are beyond their bounds, in words. One without a value is: nothing says that it is within."""
    beyond = []
    for field, bound in bounds.items():
        value = figures[field]
        if not isinstance(value, int | float):
            beyond.append(f"{field} has no value")
            continue
        low = -math.inf if bound.min is None else bound.min
        high = math.inf if bound.max is None else bound.max
        if low > high:  # the allowed angles go through 180
            if high < value < low:
                beyond.append(f"{field} {value:.5g} outside {low:g} through 180 to {high:g}")
        elif value < low:
            beyond.append(f"{field} {value:.5g} under {low:g}")
        elif value > high:
            beyond.append(f"{field} {value:.5g} over {high:g}")
    return beyond


def verdict(beyond: Sequence[str], bounds: Mapping[str, Bound]) -> dict[str, Value]:
    """The fields that say how a region compares with its limits."""
    return {
        "status": "beyond" if beyond else "within" if bounds else "measured",
        "why": ", ".join(beyond),
    }


def worst(regions: Sequence[Mapping[str, Value]]) -> Status:
    """The worst status of regions."""
    statuses = [figures["status"] for figures in regions]
    return "beyond" if "beyond" in statuses else "within" if "within" in statuses else "measured"
