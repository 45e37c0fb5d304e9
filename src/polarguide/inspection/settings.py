"""Settings of ``inspect``, and the result of a check. This module does not import torch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from polarguide.core.options import Transfer

Normals = Literal["auto", "points", "train"]


@dataclass(frozen=True)
class InspectSettings:
    """Settings of an inspection.

    Attributes:
        normals: Evidence on the angles. points uses only points that several views observe. train also trains normals
            without polarization. auto trains if the points do not decide.
        steps: Optimizer steps of this training.
        refractive_index: Refractive index of the surfaces. By default, that of scene.json, else 1.5.
        downscale: Width of pixel blocks that are averaged first. 0 averages until pictures are at most 640 pixels wide
            and high.
        transfer: Encoding of radiance in the files.
    """

    normals: Normals = "auto"
    steps: Annotated[int, Meta(ge=1)] = 600
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | None = None
    downscale: Annotated[int, Meta(ge=0)] = 0
    transfer: Transfer = "linear"


Verdict = Literal["ok", "warning", "wrong", "n/a", "not verified"]
ORDER: tuple[Verdict, ...] = ("n/a", "ok", "not verified", "warning", "wrong")
"""Verdicts of checks in increasing severity."""
TITLES = {
    "pair_sums": "Consistency of the four angles",
    "encoding": "Linear encoding",
    "exposure": "Equal exposure of the angles",
    "saturation": "Saturation",
    "noise": "Noise",
    "brightness": "Brightness",
    "low_dolp": "Strength of polarization",
    "analyzers": "Analyzers of the sensor",
    "view_exposure": "Equal exposure of the views",
    "poses": "Pose quality",
    "focal_lengths": "Focal lengths",
    "coverage": "Coverage",
    "held_out": "Surroundings of the held-out views",
    "angle_order": "Order of the angles",
    "handedness": "Sense of the angles",
    "zero_offset": "Zero of the angles",
    "dielectric": "Polarization that a dielectric can have",
    "pictures": "Pictures",
    "agreement": "Agreement of the angles",
    "modulation": "Filter",
    "angles": "Angles of the pictures",
}
"""Headings of the checks on the page, by key."""
LCD_TEST = (
    "Hold the filter in front of an LCD screen and rotate it. The side that faces the screen when it becomes dark must "
    "face the scene. If the filter was right, photograph glossy surfaces obliquely (50 to 65 degrees)."
)
"""Advice for pictures whose brightness does not change with the polarizer angle."""


@dataclass(frozen=True)
class Check:
    """Result of one check of a capture.

    Attributes:
        key: name in ``inspection.json``, one of ``TITLES``.
        verdict: "ok", "warning" (the user has to decide), "wrong", "n/a" (the check is impossible), or "not verified"
            (the check is impossible, but training relies on the property).
        finding: result in one or two sentences.
        remedy: advice. Empty if nothing is to be done.
        views: affected views. Empty if the result concerns all views.
        figures: numbers on which the verdict is based.
    """

    key: str
    verdict: Verdict
    finding: str
    remedy: str = ""
    views: tuple[str, ...] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the check on the page."""
        return TITLES[self.key]

    def record(self) -> dict[str, Any]:
        """Return the check as JSON types. Numbers that are not finite become null."""
        return dict(json_value({"key": self.key, "title": self.title, **vars(self)}))


def first_outcome(*rows: tuple[object, Verdict, str, str]) -> tuple[Verdict, str, str]:
    """Return verdict, finding and remedy of the first row whose condition is true.

    Args:
        rows: possible outcomes, the most important first. Each has a condition, a verdict, a finding and a remedy.
    """
    return next(outcome for condition, *outcome in rows if condition)  # type: ignore[return-value]


def worst(checks: Iterable[Check]) -> Verdict:
    """Return the worst verdict among the checks, or "n/a" if there are no checks."""
    return max((check.verdict for check in checks), key=ORDER.index, default="n/a")


def json_value(value: Any) -> Any:
    """Convert a value to JSON types. Floats are rounded to six digits, and become null if they are not finite."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
