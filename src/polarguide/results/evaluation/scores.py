"""Scores of a rendered view, errors of each object, and means over views."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from polarguide.capture.metadata import SceneObject
from polarguide.optics.color import shown
from polarguide.results.evaluation.metrics import LEAST_POLARIZED, Selection, decibels, normal_angles_deg
from polarguide.results.evaluation.perceptual import flip, lpips
from polarguide.results.evaluation.table import (
    HIGHEST_PSNR,
    OBJECT_METRICS,
    PART_SHARES,
    VIEW_METRICS,
    Layers,
)
from polarguide.results.evaluation.target import ViewTarget
from polarguide.shading.result import RenderResult

HALF = 0.5
"""Metalness above which a pixel counts as metal."""


class ErrorMap(NamedTuple):
    """Error of each pixel. The metric of a region is the sum of ``error``, divided by the sum of ``weight``.

    Attributes:
        error: [H, W], 0 outside the mask.
        weight: [H, W], 0 outside the mask.
    """

    error: Tensor
    weight: Tensor


def error_maps(target: ViewTarget, layers: Layers) -> dict[str, ErrorMap]:
    """Return float64 error maps of those ``OBJECT_METRICS`` for which layers and ground truth exist.

    The error of a PSNR is the squared error of displayed pictures, averaged over channels. The error of normals is in
    degrees. The Stokes error is |S1 error| + |S2 error|, summed over channels, with |S1| + |S2| as weight.
    """
    maps = {"psnr": _squared(layers["final"], target.photograph, target.valid)}
    for name in ("specular", "diffuse"):
        lobe = getattr(target, name)
        maps[f"{name}_psnr"] = _squared(layers[name], None if lobe is None else lobe / 2, target.foreground)
    normal = layers["normal"]
    if normal is not None and target.normal is not None and target.surface is not None:
        keep = target.surface.mask
        angles = torch.where(keep, normal_angles_deg(normal, target.normal), 0.0)
        maps["normal_mae_deg"] = ErrorMap(angles, keep.to(torch.float64))
    stokes = layers.get("polarization")
    measured = target.polarization
    if stokes is not None and measured is not None and target.polarized is not None:
        errors = ((stokes - measured).abs().sum(dim=-1), measured.abs().sum(dim=-1))
        keep = target.polarized.mask
        maps["stokes_error"] = ErrorMap(*(torch.where(keep, values, 0.0) for values in errors))
    return {key: error for key in OBJECT_METRICS if (error := maps.get(key)) is not None}


def _squared(pred: Tensor | None, true: Tensor | None, keep: Selection | None) -> ErrorMap | None:
    if pred is None or true is None or keep is None:
        return None
    error = ((shown(pred) - shown(true)) ** 2).mean(dim=-1)
    return ErrorMap(torch.where(keep.mask, error, 0.0), keep.mask.to(torch.float64))


class ErrorsByObject:
    """Accumulator of errors over all views, for each object and each class of material.

    The sums stay on the device of the views until ``records`` reads them.

    Args:
        objects: the objects in the order of ``ViewTarget.owner``.
    """

    def __init__(self, objects: Sequence[SceneObject]) -> None:
        self._objects = tuple(objects)
        self._kinds = sorted({item.material.kind for item in objects if item.material.kind is not None})
        self._members = torch.tensor(
            [[item.material.kind == kind for item in objects] for kind in self._kinds], dtype=torch.float64
        ).reshape(len(self._kinds), len(self._objects))
        self._sums: Tensor | None = None
        self._shares: list[str] = []

    def add(self, target: ViewTarget, layers: Layers) -> None:
        """Add the errors of a view. A view without a map of objects adds no error."""
        owner = target.owner
        if owner is None:
            return
        maps = error_maps(target, layers)
        counts = (target.valid if target.foreground is None else target.foreground).mask
        nothing = torch.zeros_like(target.photograph[..., 0])
        lit = nothing if target.polarized is None else 2 * target.photograph.sum(-1) * target.polarized.mask
        columns = [values for key in OBJECT_METRICS for values in maps.get(key, (nothing, nothing))]
        shares = {metric.key: layers.get(layer) for metric, layer in PART_SHARES.items()}
        self._shares = [key for key, values in shares.items() if values is not None]
        columns += [
            nothing if values is None else (values > HALF).to(torch.float64) for values in shares.values()
        ]
        columns += [lit, counts.to(torch.float64)]
        table = torch.stack(columns, dim=-1).flatten(0, 1) * counts.flatten()[:, None]
        sums = torch.stack(
            [(owner.flatten() == place).to(table.dtype) @ table for place in range(len(self._objects))]
        )
        sums = torch.cat((sums, self._members.to(sums.device) @ sums))
        sums = torch.cat((sums, (sums[:, -1:] > 0).to(sums.dtype)), dim=1)
        self._sums = sums if self._sums is None else self._sums + sums

    def records(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the errors of each object and of each class of material, as in ``metrics.json``.

        The call waits for the device.
        """
        if self._sums is None:
            return {}, {}
        rows = [_record(row, self._shares) for row in self._sums.cpu().tolist()]
        count = len(self._objects)
        by_object = {
            item.name: {"material": item.material.kind, **row}
            for item, row in zip(self._objects, rows[:count], strict=True)
        }
        return by_object, dict(zip(self._kinds, rows[count:], strict=True))


def _record(sums: Sequence[float], measured: Collection[str]) -> dict[str, Any]:
    *sums, light, pixels, views = sums
    pairs = sums[: 2 * len(OBJECT_METRICS)]
    shares = sums[2 * len(OBJECT_METRICS) :]
    record: dict[str, Any] = {"pixels": int(pixels), "views": int(views)}
    for key, error, weight in zip(OBJECT_METRICS, pairs[::2], pairs[1::2], strict=True):
        counted = weight > 0 and (key != "stokes_error" or weight >= LEAST_POLARIZED * light)
        value = error / weight if counted else None
        if value is not None and key.endswith("psnr"):
            value = min(decibels(value), HIGHEST_PSNR)
        record[key] = value
    for metric, count in zip(PART_SHARES, shares, strict=True):
        if metric.key in measured and pixels:
            record[metric.key] = count / pixels
    return record


_NO_LAYERS = "the recipe has no specular and diffuse layers for a prediction"
_UNDETERMINED = "the pictures of the view do not determine the Stokes vectors"
_NO_POLARIZATION = "the measured polarization of the scored pixels is negligible"

ViewScores = dict[str, float | str | None]
"""Scores of one view by key. None represents a missing score.

A score is missing without ground truth, without the layer, or without a pixel to score. The texts ``lpips_reason``,
``flip_reason`` and ``stokes_error_reason`` explain why ``lpips``, ``flip`` and ``stokes_error`` are missing.
``nonfinite_pixels`` is the number of pixels with NaN or infinity in a rendered layer. It is present only if there are
such pixels. They are scored as black, and their normals with an error of 90 degrees.
"""


def score_view(
    target: ViewTarget,
    rendered: RenderResult,
    *,
    stokes: Tensor | None = None,
    in_front: Tensor | None = None,
    in_free_space: Tensor | None = None,
    by_object: ErrorsByObject | None = None,
) -> ViewScores:
    """Score one rendered view on the device of its rendering.

    The function reads all results from the device in one transfer, and LPIPS in a second one. FLIP is computed on the
    CPU.

    Args:
        target: the ground truth of the view, on the same device.
        rendered: the rendering. Missing layers are not scored.
        stokes: [3, H, W, 3] predicted Stokes vectors on the scale of a picture S0/2, or None without a prediction.
        in_front: [H, W] alpha in front of ``HAZE_DEPTH`` times the true depth. None skips its metric of haze.
        in_free_space: [H, W] the same for the depth of surfaces that training views confirm.
        by_object: receives the errors of the view.

    Returns:
        The score of each metric by key. PSNRs are at most ``HIGHEST_PSNR``.

    Raises:
        ValueError: the shapes do not match.
    """
    names = ("final", "normal", "specular", "diffuse", "depth", "alpha", *PART_SHARES.values())
    layers = {name: _detached(rendered.layers.get(name)) for name in names}
    layers["polarization"] = None if stokes is None else _detached(stokes[1:].movedim(0, 2).flatten(2))
    layers["in_front"] = _detached(in_front)
    layers["in_free_space"] = _detached(in_free_space)
    broken = torch.zeros_like(target.valid.mask)
    for name, layer in layers.items():
        if layer is not None:
            nonfinite = ~(layer.isfinite() if layer.ndim == 2 else layer.isfinite().all(-1))
            broken |= nonfinite
            layers[name] = torch.where(nonfinite if layer.ndim == 2 else nonfinite[..., None], 0.0, layer)
    final = layers["final"]
    assert final is not None
    distance, reason = lpips(final, target.photograph, target.valid.mask)
    flip_score, flip_reason = flip(final, target.photograph, target.valid.mask)
    if by_object is not None:
        by_object.add(target, layers)
    measures = {m.key: m.measure(target, layers) for m in VIEW_METRICS if m.measure is not None}
    measured = {key: value.to(torch.float64) for key, value in measures.items() if value is not None}
    # Scoring waits for the device only here.
    nonfinite_pixels, *values = (
        torch.stack([broken.sum().to(torch.float64), *measured.values()]).cpu().tolist()
    )
    numbers = dict(zip(measured, values, strict=True))
    scores: ViewScores = {}
    for metric in VIEW_METRICS:
        value = numbers.get(metric.key, math.nan)
        if metric.unit == "dB":
            value = min(decibels(value), HIGHEST_PSNR)
        scores[metric.key] = _number(value)
    scores |= {"lpips": distance, "lpips_reason": reason, "flip": flip_score}
    if flip_reason is not None:
        scores["flip_reason"] = flip_reason
    if scores["stokes_error"] is None:
        measurement_reason = _NO_POLARIZATION if target.polarization is not None else _UNDETERMINED
        scores["stokes_error_reason"] = _NO_LAYERS if stokes is None else measurement_reason
    if nonfinite_pixels:
        scores["nonfinite_pixels"] = int(nonfinite_pixels)
    return scores


def summarize(per_view: Mapping[str, ViewScores]) -> dict[str, float | str | None]:
    """Average each score over the views. The PSNR of a run is the mean of its PSNRs, not the PSNR of its mean error.

    Args:
        per_view: scores by view name.

    Returns:
        The keys of ``VIEW_METRICS``: the mean over the views with a value, or None if no view has one.
            ``lpips_reason`` is the reason of the first view without LPIPS. ``flip_reason`` and
            ``stokes_error_reason`` are present if no view has a value.
    """
    means: dict[str, float | str | None] = {}
    for metric in VIEW_METRICS:
        values = [v for scores in per_view.values() if (v := _number(scores.get(metric.key))) is not None]
        means[metric.key] = math.fsum(values) / len(values) if values else None
    reasons = (scores.get("lpips_reason") for scores in per_view.values())
    means["lpips_reason"] = next((reason for reason in reasons if reason), None)
    for key in ("flip", "stokes_error"):
        if means[key] is None:
            reasons = (scores.get(f"{key}_reason") for scores in per_view.values())
            means[f"{key}_reason"] = next((reason for reason in reasons if reason), None)
    return means


def _detached(layer: Tensor | None) -> Tensor | None:
    return None if layer is None else layer.detach().to(torch.float64)


def _number(value: object) -> float | None:
    """Return a finite number as a float; return None for any other value."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
