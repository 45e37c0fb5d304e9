"""Table of all metrics, which defines the computation and the display of each metric.

To add a metric, add a row to this table and a function to ``metrics.py``, or install a package that provides it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

from torch import Tensor

from polarguide.core.definitions import definition_digest
from polarguide.results.evaluation.metric import Layers, Measure, Metric, checked_metric, plugged_metrics
from polarguide.results.evaluation.metrics import (
    beyond_share,
    coverage_error,
    depth_error_percent,
    layer_error,
    mean_alpha,
    normal_mae_deg,
    normal_within_11,
    seen_share,
    squared_error,
    ssim,
    stokes_error,
)
from polarguide.results.evaluation.target import ViewTarget

HIGHEST_PSNR = 100.0
"""Upper bound of a recorded PSNR. Equal pictures have an infinite PSNR, which JSON cannot represent."""
MESH_LABEL = "mesh F-score 1 %"
WORST_VIEWS = ("psnr", "haze_free")
"""Keys of the metrics whose worst view is listed beside the mean."""


def _comparison(compare: Callable[..., Tensor], layer: str, *known: str) -> Measure:
    """Create a measure that compares a rendered layer with attributes of the target.

    Args:
        compare: function of the layer and the attributes.
        layer: name of the layer.
        known: names of the attributes, such as the true layer and a region.
    """

    def measure(target: ViewTarget, layers: Layers) -> Tensor | None:
        arguments = [layers[layer], *(getattr(target, name) for name in known)]
        return None if any(values is None for values in arguments) else compare(*arguments)

    return measure


def _layer(name: str, *, aligned: bool = False, region: str = "foreground") -> Measure:
    """Create a measure for the squared error of a layer, such as specular, in a region of the picture."""
    return _comparison(partial(layer_error, aligned=aligned), name, name, region)


def _mesh(key: str, label: str, *, shown: Literal["tables", "files"] = "files") -> Metric:
    """Create a metric of the mesh in percent."""
    return Metric(key, label, "%", 1, "higher", of="run", shown=shown, factor=100.0)


BUILT_IN_METRICS: tuple[Metric, ...] = (
    Metric(
        "psnr", "PSNR", "dB", 2, "higher", measure=_comparison(squared_error, "final", "photograph", "valid")
    ),
    Metric(
        "psnr_seen",
        "PSNR seen",
        "dB",
        2,
        "higher",
        measure=_comparison(squared_error, "final", "photograph", "seen"),
    ),
    Metric(
        "seen_share",
        "seen pixels",
        "%",
        1,
        None,
        measure=_comparison(seen_share, "final", "seen", "valid"),
        factor=100.0,
    ),
    Metric(
        "psnr_foreground",
        "PSNR foreground",
        "dB",
        2,
        "higher",
        measure=_comparison(squared_error, "final", "photograph", "foreground"),
    ),
    Metric(
        "psnr_reflective",
        "PSNR reflective",
        "dB",
        2,
        "higher",
        measure=_comparison(squared_error, "final", "photograph", "reflective"),
    ),
    Metric(
        "ssim", "SSIM", "", 3, "higher", measure=_comparison(ssim, "final", "photograph", "valid", "windows")
    ),
    Metric(
        "ssim_seen",
        "SSIM seen",
        "",
        3,
        "higher",
        measure=_comparison(ssim, "final", "photograph", "seen", "seen_windows"),
    ),
    Metric("lpips", "LPIPS", "", 3, "lower"),
    Metric("flip", "FLIP", "", 3, "lower"),
    Metric(
        "normal_mae_deg",
        "normal error",
        "deg",
        1,
        "lower",
        measure=_comparison(normal_mae_deg, "normal", "normal", "surface"),
    ),
    Metric(
        "normal_within_11",
        "normals within 11.25 deg",
        "%",
        1,
        "higher",
        measure=_comparison(normal_within_11, "normal", "normal", "surface"),
        factor=100.0,
    ),
    Metric("specular_psnr", "specular PSNR", "dB", 2, "higher", measure=_layer("specular")),
    Metric("diffuse_psnr", "diffuse PSNR", "dB", 2, "higher", measure=_layer("diffuse")),
    Metric(
        "specular_psnr_aligned",
        "specular PSNR aligned",
        "dB",
        2,
        "higher",
        measure=_layer("specular", aligned=True),
        shown="files",
    ),
    Metric(
        "diffuse_psnr_aligned",
        "diffuse PSNR aligned",
        "dB",
        2,
        "higher",
        measure=_layer("diffuse", aligned=True),
        shown="files",
    ),
    Metric(
        "specular_psnr_dielectric",
        "specular PSNR without metals",
        "dB",
        2,
        "higher",
        measure=_layer("specular", region="dielectric"),
        shown="files",
    ),
    Metric(
        "diffuse_psnr_dielectric",
        "diffuse PSNR without metals",
        "dB",
        2,
        "higher",
        measure=_layer("diffuse", region="dielectric"),
        shown="files",
    ),
    Metric(
        "stokes_error",
        "Stokes error",
        "",
        3,
        "lower",
        measure=_comparison(stokes_error, "polarization", "polarization", "polarized", "photograph"),
    ),
    Metric(
        "stokes_error_seen",
        "Stokes error seen",
        "",
        3,
        "lower",
        measure=_comparison(stokes_error, "polarization", "polarization", "seen_polarized", "photograph"),
    ),
    Metric(
        "depth_error_median_percent",
        "depth error",
        "%",
        2,
        "lower",
        measure=_comparison(depth_error_percent, "depth", "depth", "near", "extent"),
    ),
    Metric(
        "haze_free",
        "haze",
        "%",
        2,
        "lower",
        measure=_comparison(mean_alpha, "in_free_space", "confirmed"),
        factor=100.0,
    ),
    Metric(
        "haze_true",
        "haze by true depth",
        "%",
        2,
        "lower",
        measure=_comparison(mean_alpha, "in_front", "smooth"),
        shown="files",
        factor=100.0,
    ),
    Metric(
        "depth_beyond",
        "depth beyond",
        "%",
        2,
        "lower",
        measure=_comparison(beyond_share, "depth", "depth", "smooth"),
        shown="files",
        factor=100.0,
    ),
    Metric(
        "coverage_error",
        "coverage error",
        "%",
        2,
        "lower",
        measure=_comparison(coverage_error, "alpha", "mask", "valid"),
        shown="files",
        factor=100.0,
    ),
    Metric(
        "alpha_outside",
        "alpha outside the mask",
        "%",
        2,
        "lower",
        measure=_comparison(mean_alpha, "alpha", "beyond"),
        shown="files",
        factor=100.0,
    ),
    _mesh("mesh_fscore_1", MESH_LABEL, shown="tables"),
    _mesh("mesh_fscore_05", "mesh F-score 0.5 %"),
    _mesh("mesh_accuracy_1", "mesh accuracy 1 %"),
    _mesh("mesh_accuracy_05", "mesh accuracy 0.5 %"),
    _mesh("mesh_completeness_1", "mesh completeness 1 %"),
    _mesh("mesh_completeness_05", "mesh completeness 0.5 %"),
    Metric("gaussians", "Gaussians", "", 0, None, of="run"),
    Metric("fps", "FPS", "", 1, "higher", of="run", timed=True),
    Metric("fps_layers", "FPS all layers", "", 1, "higher", of="run", shown="files", timed=True),
    Metric("train_seconds", "training", "s", 0, "lower", of="run", timed=True),
    Metric("steps", "steps", "", 0, None, of="run", shown="record"),
    Metric("peak_memory_mib", "peak memory", "MiB", 0, "lower", of="run", shown="record"),
)
"""Metrics that this package defines."""
PLUGGED = list(plugged_metrics({metric.key for metric in BUILT_IN_METRICS}))
"""Metrics that other installed packages define, and registered metrics."""
REGISTERED: dict[str, tuple[Metric, str]] = {}
"""Metrics of ``register_metric`` by key, as the user defined them, each with a digest of its definition."""
METRICS = [*BUILT_IN_METRICS, *PLUGGED]
"""All metrics in the order of display."""
OBJECT_METRICS = ("psnr", "normal_mae_deg", "specular_psnr", "diffuse_psnr", "stokes_error")
"""Keys of the metrics that are recorded for each object and each material."""
VIEW_METRICS = [metric for metric in METRICS if metric.of == "view"]
"""Metrics with a value for each view. A run records the mean over views."""
RUN_METRICS = tuple(metric for metric in METRICS if metric.of == "run")
"""Metrics with one value for a run. Each value may be null."""
COLUMNS = [metric for metric in METRICS if metric.shown != "record"]
"""Metrics that a comparison of runs collects."""
METAL_SHARE = Metric("metal_share", "taken for metal", "%", 1, None, factor=100.0)
"""Share of the pixels of an object with a metalness above one half, for recipes with metals."""
UNDECIDED_SHARE = Metric("undecided_share", "undecided metal", "%", 1, None, factor=100.0)
"""Share of the pixels of an object that are dielectrics and may be metals, for trainings that search for metals."""
PART_SHARES = {METAL_SHARE: "metalness", UNDECIDED_SHARE: "undecided"}
"""Layer of each share. A pixel counts if the value of the layer is above one half."""
PART_METRICS = (*(metric for metric in COLUMNS if metric.of == "view"), *PART_SHARES)
"""Metrics of an object or of a class of material."""


def register_metric(metric: Metric, digest: str | None = None) -> None:
    """Add a metric of views to all scores and tables of this process. It replaces a registered metric of the same key.

    Args:
        metric: the metric.
        digest: digest of its definition, if another process has computed it.

    Raises:
        PolarguideError: the metric is invalid, or its key belongs to another metric.
    """
    others = {other.key for other in METRICS} - REGISTERED.keys()
    checked = checked_metric(metric, "metrics", others)
    for metrics in (PLUGGED, METRICS, VIEW_METRICS, COLUMNS):
        metrics[:] = [other for other in metrics if other.key != metric.key]
        if metrics is not COLUMNS or metric.shown != "record":
            metrics.append(checked)
    REGISTERED[metric.key] = (metric, digest or definition_digest(metric))


def registered_digests() -> dict[str, str]:
    """Return the digest of the definition of each registered metric, by key."""
    return {key: digest for key, (_, digest) in REGISTERED.items()}


def shown_metrics(record: Mapping[str, Any], *, scores_only: bool = False) -> list[tuple[str, str]]:
    """Return the labels and values of the metrics of a run in the order of the table.

    A metric without a value is shown as "n/a" with a short reason; ``explained`` returns the long reasons. A metric
    without a value and without a reason is left out, see ``absent_metrics``. The worst view follows the mean of the
    metrics in ``WORST_VIEWS``.

    Args:
        record: record of a run from ``metrics.json``.
        scores_only: leave out metrics of the run (times, counts) and metrics without a value.

    Returns:
        Pairs of label and value with unit.
    """
    lines = []
    for metric in METRICS:
        value = record.get(metric.key)
        if metric.shown != "tables" or (scores_only and (metric.of == "run" or value is None)):
            continue
        reason = record.get(f"{metric.key}_reason")
        if value is not None or reason:
            why = str(reason).partition(": ")[0]
            lines.append((metric.label, f"n/a ({why})" if value is None else metric.text(value)))
        if metric.key in WORST_VIEWS:
            lines += _worst_view(record, metric)
    return lines


def explained(record: Mapping[str, Any]) -> list[str]:
    """Return one line for each metric that ``shown_metrics`` shows as "n/a", with the reason."""
    reasons = {
        metric.label: str(record.get(f"{metric.key}_reason") or "").partition(": ")[2]
        for metric in METRICS
        if metric.shown == "tables" and record.get(metric.key) is None
    }
    return [f"{label}: {more}" for label, more in reasons.items() if more]


def _worst_view(record: Mapping[str, Any], metric: Metric) -> list[tuple[str, str]]:
    """Return the worst value of a metric and its view as a line of the table; empty for fewer than two views."""
    scored = {name: s[metric.key] for name, s in record.get("views", {}).items() if s[metric.key] is not None}
    if len(scored) < 2:
        return []
    worst = min if metric.better == "higher" else max
    name = worst(scored, key=lambda view: scored[view])
    return [(f"{metric.label}, worst view", f"{metric.text(scored[name])} ({name})")]


def absent_metrics(record: Mapping[str, Any]) -> list[str]:
    """Return the labels of metrics without a value for which no reason is recorded.

    Either the ground truth or the layer is missing.
    """
    return [
        metric.label
        for metric in METRICS
        if metric.shown == "tables"
        and record.get(metric.key) is None
        and not record.get(f"{metric.key}_reason")
    ]
