"""Scores of one rendered view, and their means over views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from polarguide.evaluation.flip import flip
from polarguide.evaluation.lpips import lpips
from polarguide.evaluation.maps import ErrorsByObject
from polarguide.evaluation.metrics import decibels
from polarguide.evaluation.table import HIGHEST_PSNR, VIEW_METRICS
from polarguide.evaluation.target import ViewTarget

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
    rendered: Any,
    *,
    stokes: Tensor | None = None,
    in_front: Tensor | None = None,
    by_object: ErrorsByObject | None = None,
) -> ViewScores:
    """Score one rendered view, on the device where it was rendered, which is waited for once.

    (LPIPS, where its network is at hand, waits by itself: torchmetrics checks the pictures' values. FLIP is computed on
    the CPU.)

    Args:
        target: what it is compared with, on the same device.
        rendered: an object with ``final`` [H, W, 3] linear, and, each None where the recipe has no such
            layer, ``normal`` [H, W, 3] world of any length, ``specular`` and ``diffuse`` [H, W, 3] linear
            contributions to the final picture; ``depth``, ``alpha`` and ``metalness`` [H, W] may be missing.
        stokes: [3, H, W, 3] predicted Stokes vectors on the scale where the picture is S0/2; None: no prediction.
        in_front: [H, W] share of the weight before ``HAZE_DEPTH`` times the true depth; None: not measured.
        by_object: gets the view's errors added.

    Returns:
        Every per-view key. PSNRs are at most ``HIGHEST_PSNR``.

    Raises:
        ValueError: shapes that do not fit.
    """
    layers = {name: _plain(getattr(rendered, name)) for name in ("final", "normal", "specular", "diffuse")}
    layers |= {name: _plain(getattr(rendered, name, None)) for name in ("depth", "alpha", "metalness")}
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
    found = _numbers({"nonfinite_pixels": broken.sum(), **measures})
    lost_pixels = int(found.pop("nonfinite_pixels"))
    scores: ViewScores = {}
    for metric in VIEW_METRICS:
        value = found.get(metric.key, math.nan)
        if metric.unit == "dB":
            value = min(decibels(value), HIGHEST_PSNR)
        scores[metric.key] = _number(value)
    scores |= {"lpips": distance, "lpips_reason": reason, "flip": flipped}
    if flip_reason is not None:
        scores["flip_reason"] = flip_reason
    if scores["stokes_error"] is None:
        measured = _NO_POLARIZATION if target.polarization is not None else _UNDETERMINED
        scores["stokes_error_reason"] = _NO_LAYERS if stokes is None else measured
    if lost_pixels:
        scores["nonfinite_pixels"] = lost_pixels
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


def _numbers(measures: Mapping[str, Tensor | None]) -> dict[str, float]:
    """What tensors [] hold; the only place where scoring waits for their device."""
    known = {key: value.to(torch.float64) for key, value in measures.items() if value is not None}
    values: list[float] = torch.stack(list(known.values())).cpu().tolist()
    return dict(zip(known, values, strict=True))


def _plain(layer: Tensor | None) -> Tensor | None:
    return None if layer is None else layer.detach().to(torch.float64)


def _number(value: object) -> float | None:
    """None for what is not a finite number."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
