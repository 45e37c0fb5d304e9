"""Metrics of installed packages: entry points of the group ``polarguide.metrics``.

Each names a ``Metric`` of views, a sequence of them, or a function without arguments that returns either. One that
cannot be used is left out with a warning: scores do not depend on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.results.evaluation.metric import Metric

GROUP = "polarguide.metrics"


def plugged_metrics(known: Collection[str]) -> tuple[Metric, ...]:
    """The metrics of installed packages, in the order of their keys; ``known``: keys that they cannot have."""
    plugged: dict[str, Metric] = {}
    for entry in entry_points(group=GROUP):
        try:
            for metric in _loaded(entry):
                if metric.key in plugged or metric.key in known:
                    raise _unusable(entry, "a key of its own", f"{metric.key}, which there is")
                plugged[metric.key] = metric
        except PolarguideError as error:
            warnings.warn(f"{error} Its metrics are left out.", PolarguideWarning, stacklevel=2)
    return tuple(plugged[key] for key in sorted(plugged))


def _loaded(entry: EntryPoint) -> tuple[Metric, ...]:
    """The metrics of an entry point.

    Raises:
        PolarguideError: it cannot be loaded, or is something else.
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
