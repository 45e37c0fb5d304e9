"""Settings of ``inspect``, and the result of a check. This module does not import torch."""

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
    """Settings of an inspection.

    Attributes:
        normals: Evidence on the angles. points uses only points that several views observe; train also trains normals
            without polarization; auto trains if the points do not decide.
        steps: Optimizer steps of this training. Its state is kept in the folder of the inspection, and resumed.
        refractive_index: Refractive index of the surfaces. By default, that of scene.json, else 1.5.
        downscale: Side of pixel boxes that are averaged first. 0 averages until pictures are at most 640 pixels wide.
        transfer: Encoding of radiance in the files.
        calibration: File of polarguide calibrate. The inspection corrects the scene with it.
    """

    normals: Normals = "auto"
    steps: Annotated[int, Meta(ge=1)] = 600
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | None = None
    downscale: Annotated[int, Meta(ge=0)] = 0
    transfer: Transfer = "linear"
    calibration: Path | None = None


Verdict = Literal["ok", "warning", "wrong", "n/a", "not verified"]
ORDER: tuple[Verdict, ...] = ("n/a", "ok", "not verified", "warning", "wrong")
"""Verdicts from none to the worst."""
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
    "angle_order": "Order of the angles",
    "handedness": "Sense of the angles",
    "zero_offset": "Zero of the angles",
    "dielectric": "Polarization that a dielectric can have",
    "pictures": "Pictures",
    "agreement": "Agreement of the angles",
    "modulation": "Filter",
    "angles": "Angles of the pictures",
}
"""Headings of the checks by key."""
LCD_TEST = (
    "Hold the filter in front of an LCD screen and rotate it. The side that faces the screen when it becomes dark must "
    "face the scene. If the filter was right, photograph glossy surfaces obliquely (50 to 65 degrees)."
)
"""Advice for pictures without modulation."""


@dataclass(frozen=True)
class Check:
    """Outcome of one check.

    Attributes:
        key: name in ``inspection.json``, one of ``TITLES``.
        verdict: "ok"; "warning" for a decision by the user; "wrong"; "n/a" for an impossible check; "not verified" for
            an impossible check of a property that training relies on.
        finding: result, one or two sentences.
        remedy: advice; empty if nothing is to be done.
        views: views concerned; empty for all.
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
        """Heading on the page."""
        return TITLES[self.key]

    def record(self) -> dict[str, Any]:
        """Return the check as JSON types; numbers that are not finite become null."""
        return dict(json_value({"key": self.key, "title": self.title, **vars(self)}))


def first_outcome(*rows: tuple[object, Verdict, str, str]) -> tuple[Verdict, str, str]:
    """Return verdict, finding and remedy of the first row whose condition holds.

    Args:
        rows: condition, verdict, finding and remedy of each possible outcome, the most important first.
    """
    return next(outcome for condition, *outcome in rows if condition)  # type: ignore[return-value]


def worst(checks: Iterable[Check]) -> Verdict:
    """Return the worst verdict among the checks; "n/a" without checks."""
    return max((check.verdict for check in checks), key=ORDER.index, default="n/a")


def json_value(value: Any) -> Any:
    """Return a value as JSON types: floats rounded to six digits, null if they are not finite."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
