"""Scores of one rendered view, and their means over views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from polarguide.evaluation.lpips import lpips
from polarguide.evaluation.metrics import decibels
from polarguide.evaluation.table import HIGHEST_PSNR, VIEW_METRICS
from polarguide.evaluation.target import ViewTarget

ViewScores = dict[str, float | str | None]
"""The scores of one view by key. None where one is not defined: no ground truth, no such layer, no pixel that counts.

``lpips_reason`` says why ``lpips`` is None. ``nonfinite_pixels`` is there when the rendered pictures held NaN or
infinity, and counts the pixels; they were scored as black, and their normals as 90 degrees off.
"""


def score_view(target: ViewTarget, rendered: Any) -> ViewScores:
    """Score one rendered view, on the device where it was rendered, which is waited for once.

    (LPIPS, where its network is at hand, waits by itself: torchmetrics checks the pictures' values.)

    Args:
        target: what it is compared with, on the same device.
        rendered: an object with ``final`` [H, W, 3] linear, and, each None where the recipe has no such
            layer, ``normal`` [H, W, 3] world of any length, ``specular`` and ``diffuse`` [H, W, 3] linear
            contributions to the final picture.

    Returns:
        Every per-view key. PSNRs are at most ``HIGHEST_PSNR``.

    Raises:
        ValueError: shapes that do not fit.
    """
    layers = {name: _plain(getattr(rendered, name)) for name in ("final", "normal", "specular", "diffuse")}
    broken = torch.zeros_like(target.valid.mask)
    for name, layer in layers.items():
        if layer is not None:
            lost = ~layer.isfinite().all(-1)
            broken |= lost
            layers[name] = torch.where(lost[..., None], 0.0, layer)
    final = layers["final"]
    assert final is not None
    distance, reason = lpips(final, target.photograph, target.valid.mask)
    measures = {m.key: m.measure(target, layers) for m in VIEW_METRICS if m.measure is not None}
    found = _numbers({"nonfinite_pixels": broken.sum(), **measures})
    lost_pixels = int(found.pop("nonfinite_pixels"))
    scores: ViewScores = {}
    for metric in VIEW_METRICS:
        value = found.get(metric.key, math.nan)
        if metric.unit == "dB":
            value = min(decibels(value), HIGHEST_PSNR)
        scores[metric.key] = _number(value)
    scores |= {"lpips": distance, "lpips_reason": reason}
    if lost_pixels:
        scores["nonfinite_pixels"] = lost_pixels
    return scores


def summarize(per_view: Mapping[str, ViewScores]) -> dict[str, float | str | None]:
    """Plain means over views (a mean of PSNRs, not a PSNR of means).

    Args:
        per_view: the scores by view name.

    Returns:
        The keys of ``VIEW_METRICS``, each the mean over the views where it is a number, None where it is in no
        view; and ``lpips_reason``, the reason of the first view without LPIPS, else None.
    """
    means: dict[str, float | str | None] = {}
    for metric in VIEW_METRICS:
        values = [v for scores in per_view.values() if (v := _number(scores.get(metric.key))) is not None]
        means[metric.key] = math.fsum(values) / len(values) if values else None
    reasons = (scores.get("lpips_reason") for scores in per_view.values())
    means["lpips_reason"] = next((reason for reason in reasons if reason), None)
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
