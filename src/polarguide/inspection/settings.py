"""Settings of ``inspect``, and the result of a check. Nothing here imports torch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from polarguide.core.options import Transfer

Normals = Literal["auto", "points", "train"]


@dataclass(frozen=True)
class InspectSettings:
    """How a capture is inspected.

    Attributes:
        normals: points uses points seen in several views alone; train also trains for normals, without polarization;
            auto does so where the points do not decide.
        steps: Optimizer steps of that training. It is kept in the folder of the inspection and goes on where it
            stopped.
        refractive_index: Of the surfaces; without it as scene.json says, else 1.5.
        downscale: Average the pictures over boxes of this many pixels first; 0 until they are at most 640 pixels wide.
        transfer: How the files encode radiance.
        calibration: File of polarguide calibrate: inspect the scene as that of its sensor corrects it.
    """

    normals: Normals = "auto"
    steps: Annotated[int, Meta(ge=1)] = 600
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | None = None
    downscale: Annotated[int, Meta(ge=0)] = 0
    transfer: Transfer = "linear"
    calibration: Path | None = None


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
