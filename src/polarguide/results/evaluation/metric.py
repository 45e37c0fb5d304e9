"""What a metric is: its name, unit and direction, and how it is measured on a view. Other packages use it, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from polarguide.results.evaluation.target import ViewTarget

Layers = Mapping[str, Tensor | None]
"""Rendered layers of a view by name: ``final``, ``normal``, ``specular``, ``diffuse``, ``depth``, ``alpha``, the
predicted ``polarization`` and the weight ``in_front`` of the surface; None where there is none."""
Measure = Callable[[ViewTarget, Layers], Tensor | None]
"""A metric of one view as a tensor []; None where it is not defined. In place of decibels the mean squared error."""


@dataclass(frozen=True)
class Metric:
    """One quantity of a run.

    Attributes:
        key: its name in ``metrics.json``.
        label: what people read. unit: after the value; empty for none.
        digits: decimal places in tables.
        better: which direction is better; None: neither, and nothing is set in bold.
        of: whether each view has a value, and a run their mean, or only the run.
        measure: its value on a view; None where it is not a single tensor (LPIPS, FLIP), or not of a view.
        shown: "tables": console, Markdown, LaTeX and the report have it; "files": only CSV and ``results.json``;
            "record": only ``metrics.json``.
        timed: whether it counts only when measured alone; such a value may be absent without a fault.
        factor: what the value is multiplied by in tables.
    """

    key: str
    label: str
    unit: str
    digits: int
    better: Literal["higher", "lower"] | None
    of: Literal["view", "run"] = "view"
    measure: Measure | None = None
    shown: Literal["tables", "files", "record"] = "tables"
    timed: bool = False
    factor: float = 1.0

    @property
    def arrow(self) -> str:
        """Points to the better side; empty where there is none."""
        return {"higher": "↑", "lower": "↓", None: ""}[self.better]

    @property
    def heading(self) -> str:
        """Label, unit and arrow."""
        return " ".join(filter(None, (self.label, f"({self.unit})" if self.unit else "", self.arrow)))

    def text(self, value: float) -> str:
        """A recorded value as the console shows it."""
        number = f"{value:,}" if isinstance(value, int) else f"{self.factor * value:.3f}"
        return f"{number} {self.unit}".rstrip()
