"""The result of a check: verdict, finding and remedy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["ok", "warning", "wrong", "n/a", "not verified"]
ORDER: tuple[Verdict, ...] = ("n/a", "ok", "not verified", "warning", "wrong")
"""From no verdict to the worst."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        key: its name in ``inspection.json``.
        title: its heading for people.
        verdict: "ok"; "warning" where a person should decide; "wrong"; "n/a" where the check cannot be made;
            "not verified" where it cannot be made although training relies on it.
        finding: the result, one or two sentences.
        remedy: the advice; empty if nothing is to be done.
        views: the views concerned; empty for all.
        figures: the numbers that the verdict rests on.
    """

    key: str
    title: str
    verdict: Verdict
    finding: str
    remedy: str = ""
    views: tuple[str, ...] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """The check as plain JSON types; numbers that are not finite become null."""
        record: dict[str, Any] = plain(vars(self))
        return record


def worst(checks: Iterable[Check]) -> Verdict:
    """The worst verdict among the checks; "n/a" if there is none."""
    return max((check.verdict for check in checks), key=ORDER.index, default="n/a")


def plain(value: Any) -> Any:
    """A value as JSON types: floats rounded to six digits, null where they are not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
