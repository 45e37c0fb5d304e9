"""Fields of the table, and limits files."""

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
"""Version of the table. Any change of the name, order or meaning of fields increases it."""
PERCENTILES = (1, 5, 50, 95, 99)
"""Percentiles of S0 and DoLP."""
DIFFERENCE_PERCENTILE = 99
"""Percentile of absolute differences."""
Value = int | float | str | None

Status = Literal["measured", "within", "beyond", "unread"]


@dataclass(frozen=True)
class Field:
    """A field of the table.

    Attributes:
        key: name.
        unit: unit of the numbers; empty without a unit.
        about: description.
        bounded: True if a limits file may bound the field.
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
"""Fields in the order of the columns. A missing value is an empty cell, in JSON null."""
KEYS = tuple(field.key for field in FIELDS)
"""Names of the fields."""
BOUNDED = tuple(field.key for field in FIELDS if field.bounded)
"""Names of the fields that a limits file may bound."""
COMPARED = KEYS[KEYS.index("compared") :]
"""Names of the fields that need a reference."""
AXIAL = ("aolp_mean",)
"""Names of the fields with a period of 180 degrees."""
_REMEDY = "Correct the file."


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Smallest and largest allowed value; None: no bound."""

    min: float | None = None
    max: float | None = None


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a limits file.

    Attributes:
        format: version of the file, 1.
        limits: bounds by field, for all regions.
        regions: bounds by region and field, which replace those in ``limits``.
    """

    format: int = 1
    limits: dict[str, Bound] = {}
    regions: dict[str, dict[str, Bound]] = {}

    def of(self, region: str) -> dict[str, Bound]:
        """Return the bounds of a region, by field."""
        return {**self.limits, **self.regions.get(region, {})}


NO_LIMITS = Limits()
"""Limits without a bound."""


def read_limits(path: Path, regions: Collection[str], *, reference: bool) -> Limits:
    """Read a limits file.

    Args:
        path: JSON file ``{"limits": {field: {"min": a, "max": b}}, "regions": {region: {field: ...}}}``.
        regions: names of the regions.
        reference: True if shots are compared with a reference.

    Raises:
        PolarguideError: the file cannot be read, a field or region is unknown, or the file has no bound.
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
    """Validate the bound of a field.

    Raises:
        PolarguideError: the field is unknown or needs a reference, or the bound is invalid.
    """
    if field not in BOUNDED:
        near = " or ".join(difflib.get_close_matches(field, BOUNDED, 3, 0.5))
        raise _wrong(path, place, "a field of the table", field, f"Did you mean {near}?" if near else _REMEDY)
    if field in COMPARED and not reference:
        expected = "a golden part, because this field limits the difference from it"
        remedy = "Give the golden part with --reference, or remove the field."
        raise _wrong(path, place, expected, "none", remedy)
    numbers = [value for value in (bound.min, bound.max) if value is not None]
    if not numbers:
        raise _wrong(path, place, "min, max or both", "neither")
    found = " and ".join(f"{value:g}" for value in numbers)
    if field in AXIAL and not all(0 <= value <= 180 for value in numbers):
        raise _wrong(path, place, "angles from 0 to 180", found)
    if field not in AXIAL and numbers[0] > numbers[-1]:
        raise _wrong(path, place, "a min up to the max", found)


def _wrong(path: Path, place: str, expected: str, found: str, remedy: str = _REMEDY) -> PolarguideError:
    return PolarguideError(f"{path} ({place})", expected=expected, found=found, remedy=remedy)


def faults(figures: Mapping[str, Value], bounds: Mapping[str, Bound]) -> list[str]:
    """Describe the figures that are beyond their bounds. A missing value is beyond a bound."""
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
    """Return the status of a region, and the exceeded limits."""
    return {
        "status": "beyond" if beyond else "within" if bounds else "measured",
        "why": ", ".join(beyond),
    }


def worst(regions: Sequence[Mapping[str, Value]]) -> Status:
    """Return the worst status of regions."""
    statuses = [figures["status"] for figures in regions]
    return "beyond" if "beyond" in statuses else "within" if "within" in statuses else "measured"
