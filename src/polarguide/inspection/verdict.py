"""Verdicts: what an inspection says of one property of a capture, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["ok", "warning", "wrong", "n/a"]
ORDER: tuple[Verdict, ...] = ("n/a", "ok", "warning", "wrong")
"""From what says nothing to what is worst."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        key: its name in ``inspection.json``.
        title: its name for people.
        verdict: "ok"; "warning" where a person should decide; "wrong"; "n/a" where the capture cannot carry the check.
        finding: what was found, a sentence or two.
        remedy: what to do; empty where there is nothing to do.
        views: the views it is about, where it is not about all.
        figures: the numbers behind it.
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
        return {
            "key": self.key,
            "title": self.title,
            "verdict": self.verdict,
            "finding": self.finding,
            "remedy": self.remedy,
            "views": list(self.views),
            "figures": plain(self.figures),
        }


def worst(checks: Iterable[Check]) -> Verdict:
    """The worst verdict among the checks; "n/a" if there is none."""
    return max((check.verdict for check in checks), key=ORDER.index, default="n/a")


def plain(value: Any) -> Any:
    """A value as JSON types: floats rounded to six digits, not finite ones null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
