"""Scores of one rendered view, sums of its errors by object, and means over views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from polarguide.capture.metadata import SceneObject
from polarguide.optics.color import shown
from polarguide.results.evaluation.metrics import LEAST_POLARIZED, Selection, decibels, normal_angles_deg
from polarguide.results.evaluation.perceptual import flip, lpips
from polarguide.results.evaluation.table import HIGHEST_PSNR, OBJECT_METRICS, VIEW_METRICS, Layers
from polarguide.results.evaluation.target import ViewTarget
from polarguide.shading.result import RenderResult

HALF = 0.5
"""Share of metals from which on a pixel counts as one."""


class ErrorMap(NamedTuple):
    """An error of every pixel; over any pixels the metric is the sum of ``error`` over that of ``weight``.

    Attributes:
        error: [H, W], 0 where it does not count. weight: [H, W], 0 where it does not count.
    """

    error: Tensor
    weight: Tensor


def error_maps(target: ViewTarget, layers: Layers) -> dict[str, ErrorMap]:
    """The maps of ``OBJECT_METRICS`` as far as layers and truth are there, float64.

    Squared error of shown pictures (mean over channels) for PSNRs; degrees; sum over channels of |S1 error| + |S2
    error|, whose weight is that of |S1| + |S2|.
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
    """Sums of errors over the pixels of each object, and of each class of material, in all views.

    They stay on the views' device until they are read.

    Args:
        objects: in the order of ``ViewTarget.owner``.
    """

    def __init__(self, objects: Sequence[SceneObject]) -> None:
        self._objects = tuple(objects)
        self._kinds = sorted({item.material.kind for item in objects if item.material.kind is not None})
        self._members = torch.tensor(
            [[item.material.kind == kind for item in objects] for kind in self._kinds], dtype=torch.float64
        ).reshape(len(self._kinds), len(self._objects))
        self._sums: Tensor | None = None
        self._tells_metals = False

    def add(self, target: ViewTarget, layers: Layers) -> None:
        """Add a view; one whose pixels' objects are not known adds nothing."""
        owner = target.owner
        if owner is None:
            return
        maps = error_maps(target, layers)
        counts = (target.valid if target.foreground is None else target.foreground).mask
        nothing = torch.zeros_like(target.photograph[..., 0])
        lit = nothing if target.polarized is None else 2 * target.photograph.sum(-1) * target.polarized.mask
        columns = [values for key in OBJECT_METRICS for values in maps.get(key, (nothing, nothing))]
        metalness = layers.get("metalness")
        self._tells_metals = metalness is not None
        metal = nothing if metalness is None else (metalness > HALF).to(torch.float64)
        columns += [metal, lit, counts.to(torch.float64)]
        table = torch.stack(columns, dim=-1).flatten(0, 1) * counts.flatten()[:, None]
        sums = torch.stack(
            [(owner.flatten() == place).to(table.dtype) @ table for place in range(len(self._objects))]
        )
        sums = torch.cat((sums, self._members.to(sums.device) @ sums))
        sums = torch.cat((sums, (sums[:, -1:] > 0).to(sums.dtype)), dim=1)
        self._sums = sums if self._sums is None else self._sums + sums

    def records(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Errors by the object's name, and by class of material, as ``metrics.json`` has them; waits for the device."""
        if self._sums is None:
            return {}, {}
        rows = [_record(row, metals=self._tells_metals) for row in self._sums.cpu().tolist()]
        count = len(self._objects)
        by_object = {
            item.name: {"material": item.material.kind, **row}
            for item, row in zip(self._objects, rows[:count], strict=True)
        }
        return by_object, dict(zip(self._kinds, rows[count:], strict=True))


def _record(sums: Sequence[float], *, metals: bool) -> dict[str, Any]:
    *pairs, metal, light, pixels, views = sums
    record: dict[str, Any] = {"pixels": int(pixels), "views": int(views)}
    for key, error, weight in zip(OBJECT_METRICS, pairs[::2], pairs[1::2], strict=True):
        counted = weight > 0 and (key != "stokes_error" or weight >= LEAST_POLARIZED * light)
        value = error / weight if counted else None
        if value is not None and key.endswith("psnr"):
            value = min(decibels(value), HIGHEST_PSNR)
        record[key] = value
    if metals and pixels:
        record["metal_share"] = metal / pixels
    return record


_NO_LAYERS = "the recipe has no specular and diffuse layers to predict it from"
_UNDETERMINED = "the pictures of the view do not determine a Stokes vector"
_NO_POLARIZATION = "hardly any polarization was measured where it counts"

ViewScores = dict[str, float | str | None]
"""The scores of one view by key. None where one is not defined: no ground truth, no such layer, no pixel that counts.

``lpips_reason`` says why ``lpips`` is None, ``flip_reason`` why ``flip`` is, ``stokes_error_reason`` why
``stokes_error`` is. ``nonfinite_pixels`` is
there when the rendered layers held NaN or infinity, and counts the pixels; they were scored as black, and their normals
as 90 degrees off.
"""


def score_view(
    target: ViewTarget,
    rendered: RenderResult,
    *,
    stokes: Tensor | None = None,
    in_front: Tensor | None = None,
    by_object: ErrorsByObject | None = None,
) -> ViewScores:
    """Score one rendered view, on the device where it was rendered, which is waited for once.

    (LPIPS, where its weights are at hand, waits by itself. FLIP is computed on the CPU.)

    Args:
        target: what it is compared with, on the same device.
        rendered: the rendering; layers that it does not have are not scored.
        stokes: [3, H, W, 3] predicted Stokes vectors on the scale where the picture is S0/2; None: no prediction.
        in_front: [H, W] share of the weight before ``HAZE_DEPTH`` times the true depth; None: not measured.
        by_object: gets the view's errors added.

    Returns:
        Every per-view key. PSNRs are at most ``HIGHEST_PSNR``.

    Raises:
        ValueError: shapes that do not fit.
    """
    names = ("final", "normal", "specular", "diffuse", "depth", "alpha", "metalness")
    layers = {name: _plain(rendered.layers.get(name)) for name in names}
    layers["polarization"] = None if stokes is None else _plain(stokes[1:].movedim(0, 2).flatten(2))
    layers["in_front"] = _plain(in_front)
    broken = torch.zeros_like(target.valid.mask)
    for name, layer in layers.items():
        if layer is not None:
            lost = ~(layer.isfinite() if layer.ndim == 2 else layer.isfinite().all(-1))
            broken |= lost
            layers[name] = torch.where(lost if layer.ndim == 2 else lost[..., None], 0.0, layer)
    final = layers["final"]
    assert final is not None
    distance, reason = lpips(final, target.photograph, target.valid.mask)
    flipped, flip_reason = flip(final, target.photograph, target.valid.mask)
    if by_object is not None:
        by_object.add(target, layers)
    measures = {m.key: m.measure(target, layers) for m in VIEW_METRICS if m.measure is not None}
    measured = {key: value.to(torch.float64) for key, value in measures.items() if value is not None}
    # The only place where scoring waits for the device.
    lost_pixels, *values = torch.stack([broken.sum().to(torch.float64), *measured.values()]).cpu().tolist()
    numbers = dict(zip(measured, values, strict=True))
    scores: ViewScores = {}
    for metric in VIEW_METRICS:
        value = numbers.get(metric.key, math.nan)
        if metric.unit == "dB":
            value = min(decibels(value), HIGHEST_PSNR)
        scores[metric.key] = _number(value)
    scores |= {"lpips": distance, "lpips_reason": reason, "flip": flipped}
    if flip_reason is not None:
        scores["flip_reason"] = flip_reason
    if scores["stokes_error"] is None:
        unmeasured = _NO_POLARIZATION if target.polarization is not None else _UNDETERMINED
        scores["stokes_error_reason"] = _NO_LAYERS if stokes is None else unmeasured
    if lost_pixels:
        scores["nonfinite_pixels"] = int(lost_pixels)
    return scores


def summarize(per_view: Mapping[str, ViewScores]) -> dict[str, float | str | None]:
    """Plain means over views (a mean of PSNRs, not a PSNR of means).

    Args:
        per_view: the scores by view name.

    Returns:
        The keys of ``VIEW_METRICS``, each the mean over the views where it is a number, None where it is in no
        view; ``lpips_reason``, the reason of the first view without LPIPS, else None; ``flip_reason`` and
        ``stokes_error_reason`` where no view has such a value.
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


def _plain(layer: Tensor | None) -> Tensor | None:
    return None if layer is None else layer.detach().to(torch.float64)


def _number(value: object) -> float | None:
    """None for what is not a finite number."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
