"""The fields of the table: what each line of it says."""

from __future__ import annotations

from dataclasses import dataclass

FORMAT = 1
"""Version of the table. It grows whenever a field changes its name, place or meaning, or is added."""
PERCENTILES = (1, 5, 50, 95, 99)
DIFFERENCE_PERCENTILE = 99


@dataclass(frozen=True)
class Field:
    """One field.

    Attributes:
        key: its name.
        unit: of its numbers; empty where it has none.
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
    Field("taken", "", "when the last of its files was written, UTC", False),
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
