"""A metric: its name, unit and direction, and its function on a view. Other packages add theirs.

Entry points of the group ``polarguide.metrics`` name a ``Metric`` of views, a sequence of them, or a function without
arguments that returns either. One that cannot be used is left out with a warning: scores do not depend on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from torch import Tensor

from polarguide.core.errors import PolarguideError, PolarguideWarning
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


GROUP = "polarguide.metrics"


def plugged_metrics(known: Collection[str]) -> tuple[Metric, ...]:
    """The metrics of installed packages, in the order of their keys; ``known``: keys that they cannot have."""
    plugged: dict[str, Metric] = {}
    for entry in entry_points(group=GROUP):
        try:
            for metric in _loaded(entry):
                if metric.key in plugged or metric.key in known:
                    raise _unusable(entry, "a key that no other metric has", metric.key)
                plugged[metric.key] = metric
        except PolarguideError as error:
            warnings.warn(f"{error} Its metrics are left out.", PolarguideWarning, stacklevel=2)
    return tuple(plugged[key] for key in sorted(plugged))


def _loaded(entry: EntryPoint) -> tuple[Metric, ...]:
    """The metrics of an entry point.

    Raises:
        PolarguideError: the entry point cannot be loaded, or is no metric.
    """
    try:
        loaded: Any = entry.load()
        loaded = loaded() if callable(loaded) else loaded
        metrics = (loaded,) if isinstance(loaded, Metric) else tuple(loaded)
    except Exception as error:  # another package may fail in any way
        raise _unusable(entry, "metrics", f"{type(error).__name__}: {error}") from error
    for metric in metrics:
        if not isinstance(metric, Metric):
            raise _unusable(entry, "metrics", repr(metric))
        if metric.measure is None or metric.of != "view" or not metric.key.isidentifier():
            raise _unusable(entry, "a metric of views with a measure, its key a name", repr(metric.key))
    return metrics


def _unusable(entry: EntryPoint, expected: str, found: str) -> PolarguideError:
    where = f"plug-in {entry.name} ({entry.value})"
    remedy = "Update or uninstall the package that brings it."
    return PolarguideError(where, expected=expected, found=found, remedy=remedy)
