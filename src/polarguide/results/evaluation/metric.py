"""A metric: its name, unit and direction, and its function on a view. Other packages add theirs.

Entry points of the group ``polarguide.metrics`` name a ``Metric`` of views, a sequence of them, or a function without
arguments that returns either. One that cannot be used is left out with a warning: scores do not depend on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
from torch import Tensor

from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.records import decode
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
_REMEDY = "Update or uninstall the package that brings it."
_KINDS = get_type_hints(Metric) | {"digits": Annotated[int, msgspec.Meta(ge=0, le=10)]}


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
    except (Exception, SystemExit) as error:  # another package may fail in any way
        raise _unusable(entry, "metrics", f"{type(error).__name__}: {error}") from error
    for metric in metrics:
        if not isinstance(metric, Metric):
            raise _unusable(entry, "metrics", repr(metric))
        if not callable(metric.measure) or metric.of != "view" or not str(metric.key).isidentifier():
            raise _unusable(entry, "a metric of views with a measure, its key a name", repr(metric.key))
        for name in ("label", "unit", "digits", "better", "shown", "timed", "factor"):
            where = f"plug-in {entry.name} ({entry.value}), {metric.key} ({name})"
            decode(getattr(metric, name), _KINDS[name], where, remedy=_REMEDY)
    return tuple(
        replace(metric, measure=_Guarded(entry, metric.measure)) for metric in metrics if metric.measure
    )


class _Guarded:
    """A measure of another package: where it fails, there is no value, and one warning; scores do not depend on it."""

    def __init__(self, entry: EntryPoint, measure: Measure) -> None:
        self._entry = entry
        self._measure = measure
        self._failed = False

    def __call__(self, target: ViewTarget, layers: Layers) -> Tensor | None:
        """The value as a tensor [] on the target's device; None where there is none."""
        found = ""
        try:
            value: Any = self._measure(target, layers)
            if value is None:
                return None
            if not isinstance(value, Tensor):
                found = type(value).__name__
            elif value.ndim or value.is_complex():
                found = f"a tensor {list(value.shape)} of {value.dtype}"
            else:
                return value.detach().to(target.photograph.device)
        except (Exception, SystemExit) as error:
            found = f"{type(error).__name__}: {error}"
        if not self._failed:
            self._failed = True
            fault = _unusable(self._entry, "a real tensor [] or None from its measure", found)
            warnings.warn(f"{fault} It has no value.", PolarguideWarning, stacklevel=2)
        return None


def _unusable(entry: EntryPoint, expected: str, found: str) -> PolarguideError:
    where = f"plug-in {entry.name} ({entry.value})"
    return PolarguideError(where, expected=expected, found=found, remedy=_REMEDY)
