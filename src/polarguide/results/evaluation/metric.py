"""Description of a metric: name, unit, direction, and function on a view. Installed packages can add metrics.

An entry point of the group ``polarguide.metrics`` names a ``Metric`` of views, a sequence of metrics, or a function
without arguments that returns a metric or a sequence. An invalid entry point is skipped with a warning, because the
other metrics do not depend on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
from torch import Tensor

from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.records import decode
from polarguide.results.evaluation.target import ViewTarget

Layers = Mapping[str, Tensor | None]
"""Rendered layers of a view by name; None for a missing layer.

The names are ``final``, ``normal``, ``specular``, ``diffuse``, ``depth``, ``alpha``, ``polarization`` (predicted) and
``in_front`` and ``in_free_space`` (the alpha in front of the true surface, and of a confirmed surface).
"""
Measure = Callable[[ViewTarget, Layers], Tensor | None]
"""Function that computes a metric of a view as a tensor [], or returns None if the metric is undefined.

A metric in decibels returns the mean squared error.
"""


@dataclass(frozen=True)
class Metric:
    """Metric of a run, with its display in tables.

    Attributes:
        key: name in ``metrics.json``.
        label: displayed name.
        unit: displayed unit, or an empty text.
        digits: decimal places in tables.
        better: direction of better values. None if no direction is better; then tables have no bold values.
        of: "view" if each view has a value and the run has their mean; "run" if there is one value per run.
        measure: computes the value of a view; None for LPIPS, FLIP and metrics of a run.
        shown: "tables": console, Markdown, LaTeX and report; "files": only CSV and ``results.json``;
            "record": only ``metrics.json``.
        timed: True if the value is valid only without other work on the machine. Such a value may be missing.
        factor: factor from the recorded to the displayed value.
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
        """Arrow in the direction of better values, or an empty text."""
        return {"higher": "↑", "lower": "↓", None: ""}[self.better]

    @property
    def heading(self) -> str:
        """Heading of a column: label, unit and arrow."""
        return " ".join(filter(None, (self.label, f"({self.unit})" if self.unit else "", self.arrow)))

    def text(self, value: float) -> str:
        """Format a recorded value for the console."""
        number = f"{value:,}" if isinstance(value, int) else f"{self.factor * value:.3f}"
        return f"{number} {self.unit}".rstrip()


GROUP = "polarguide.metrics"
_REMEDY = "Correct the metric, or update or uninstall the package that defines it."
_VALUE = "a real tensor [] or None from its measure"
_KINDS = get_type_hints(Metric) | {"digits": Annotated[int, msgspec.Meta(ge=0, le=10)]}


def plugged_metrics(known: Collection[str]) -> tuple[Metric, ...]:
    """Return the metrics of installed packages, sorted by key.

    Args:
        known: keys of the built-in metrics, which a package must not reuse.
    """
    plugged: dict[str, Metric] = {}
    for entry in entry_points(group=GROUP):
        where = f"plug-in {entry.name} ({entry.value})"
        try:
            for metric in _loaded(entry, where):
                checked = checked_metric(metric, where, {*known, *plugged})
                plugged[metric.key] = replace(checked, measure=_Guarded(checked.measure))
        except PolarguideError as error:
            warnings.warn(f"{error} The plug-in's metrics are left out.", PolarguideWarning, stacklevel=2)
    return tuple(plugged[key] for key in sorted(plugged))


def _loaded(entry: EntryPoint, where: str) -> tuple[Any, ...]:
    """Load the metrics of an entry point.

    Raises:
        PolarguideError: the entry point cannot be loaded.
    """
    try:
        loaded: Any = entry.load()
        loaded = loaded() if callable(loaded) else loaded
        return (loaded,) if isinstance(loaded, Metric) else tuple(loaded)
    except (Exception, SystemExit) as error:  # Another package may raise anything.
        raise _unusable(where, "metrics", f"{type(error).__name__}: {error}") from error


def checked_metric(metric: Any, where: str, taken: Collection[str]) -> Metric:
    """Return a metric of views whose measure raises only PolarguideError.

    Args:
        metric: the metric.
        where: origin of the metric for messages.
        taken: keys of other metrics.

    Raises:
        PolarguideError: the metric is invalid, or its key is taken.
    """
    if not isinstance(metric, Metric):
        raise _unusable(where, "metrics", repr(metric))
    if not callable(metric.measure) or metric.of != "view" or not str(metric.key).isidentifier():
        raise _unusable(where, "a metric of views with a measure and an identifier as key", repr(metric.key))
    for name in ("label", "unit", "digits", "better", "shown", "timed", "factor"):
        decode(getattr(metric, name), _KINDS[name], f"{where}, {metric.key} ({name})", remedy=_REMEDY)
    if metric.key in taken:
        raise _unusable(where, "a key that no other metric has", metric.key)
    return replace(metric, measure=partial(_measured, f"{where}, {metric.key}", metric.measure))


def _measured(where: str, measure: Measure, target: ViewTarget, layers: Layers) -> Tensor | None:
    """Compute the value of a view as a tensor [] on the target's device, or return None.

    Raises:
        PolarguideError: the measure fails, or returns another value.
    """
    try:
        value: Any = measure(target, layers)
    except (Exception, SystemExit) as error:
        raise _unusable(where, _VALUE, f"{type(error).__name__}: {error}") from error
    if value is None:
        return None
    if not isinstance(value, Tensor):
        raise _unusable(where, _VALUE, type(value).__name__)
    if value.ndim or value.is_complex():
        raise _unusable(where, _VALUE, f"a tensor {list(value.shape)} of {value.dtype}")
    return value.detach().to(target.photograph.device)


class _Guarded:
    """Wrapper of a measure from another package, which must not stop the scoring.

    If the measure fails, the metric has no value. The first failure causes a warning.
    """

    def __init__(self, measure: Measure | None) -> None:
        self._measure = measure
        self._failed = False

    def __call__(self, target: ViewTarget, layers: Layers) -> Tensor | None:
        """Compute the value as a tensor [] on the target's device, or return None."""
        assert self._measure is not None
        try:
            return self._measure(target, layers)
        except PolarguideError as fault:
            if not self._failed:
                self._failed = True
                warnings.warn(f"{fault} The metric has no value.", PolarguideWarning, stacklevel=2)
        return None


def _unusable(where: str, expected: str, found: str) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=found, remedy=_REMEDY)
