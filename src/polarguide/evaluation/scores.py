"""Scores of one rendered view, and their means over views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypedDict, cast

import torch
from torch import Tensor

from polarguide.evaluation.lpips import lpips
from polarguide.evaluation.metrics import (
    decibels,
    layer_error,
    normal_mae_deg,
    normal_within_11,
    squared_error,
    ssim,
)
from polarguide.evaluation.target import ViewTarget

PERFECT_PSNR = 100.0
"""What a PSNR above it, and the infinite one of equal pictures, is recorded as: JSON has no infinity."""

MEAN_KEYS = (
    "psnr",
    "psnr_foreground",
    "psnr_reflective",
    "ssim",
    "lpips",
    "normal_mae_deg",
    "normal_within_11",
    "specular_psnr",
    "diffuse_psnr",
    "specular_psnr_aligned",
    "diffuse_psnr_aligned",
)
"""The keys of one view that are averaged over views."""

PICTURE_KEYS = ("psnr", "ssim", "lpips")
"""Those that need nothing but the photograph."""


class ViewScores(TypedDict, total=False):
    """The scores of one view. None where one is not defined: no truth, no such layer, no pixel that counts.

    ``lpips_reason`` says why ``lpips`` is None. ``nonfinite_pixels`` is there when the rendered pictures held
    NaN or infinity, and counts the pixels; they were scored as black, and their normals as 90 degrees off.
    """

    psnr: float | None
    psnr_foreground: float | None
    psnr_reflective: float | None
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None
    normal_mae_deg: float | None
    normal_within_11: float | None
    specular_psnr: float | None
    diffuse_psnr: float | None
    specular_psnr_aligned: float | None
    diffuse_psnr_aligned: float | None
    nonfinite_pixels: int


def score_view(target: ViewTarget, rendered: Any) -> ViewScores:
    """Score one rendered view, on the device where it was rendered, which is waited for once.

    (LPIPS, where its network is at hand, waits by itself: torchmetrics looks at the pictures' values.)

    Args:
        target: what it is compared with, on the same device.
        rendered: an object with ``final`` [H, W, 3] linear, and, each None where the recipe has no such
            layer, ``normal`` [H, W, 3] world of any length, ``specular`` and ``diffuse`` [H, W, 3] linear
            contributions to the final picture.

    Returns:
        Every per-view key. PSNRs are at most ``PERFECT_PSNR``.

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
    found = _numbers(
        {
            "psnr": squared_error(final, target.photograph, target.valid),
            "ssim": ssim(final, target.photograph, target.valid, target.windows),
            **_measures_against_scene(target, final, layers),
            "nonfinite_pixels": broken.sum(),
        }
    )
    lost_pixels = int(found.pop("nonfinite_pixels"))
    scores: dict[str, Any] = {"psnr": None, "ssim": None, "lpips": distance, "lpips_reason": reason}
    scores |= {key: None for key in MEAN_KEYS if key not in PICTURE_KEYS}
    for key, value in found.items():
        scores[key] = finite_psnr(decibels(value)) if "psnr" in key else _number(value)
    if lost_pixels:
        scores["nonfinite_pixels"] = lost_pixels
    return cast(ViewScores, scores)


def summarize(per_view: Mapping[str, ViewScores]) -> dict[str, float | str | None]:
    """Plain means over views (a mean of PSNRs, not a PSNR of means).

    Args:
        per_view: the scores by view name.

    Returns:
        The keys of ``MEAN_KEYS``, each the mean over the views where it is a number, None where it is in no
        view; and ``lpips_reason``, the reason of the first view without LPIPS, else None.
    """
    means: dict[str, float | str | None] = {}
    for key in MEAN_KEYS:
        values = [v for scores in per_view.values() if (v := _number(scores.get(key))) is not None]
        means[key] = math.fsum(values) / len(values) if values else None
    reasons = (scores.get("lpips_reason") for scores in per_view.values())
    means["lpips_reason"] = next((reason for reason in reasons if reason), None)
    return means


def finite_psnr(value: float) -> float | None:
    """Decibels as they are recorded: at most ``PERFECT_PSNR``, and None for NaN."""
    return None if math.isnan(value) else min(value, PERFECT_PSNR)


def _measures_against_scene(
    target: ViewTarget, final: Tensor, layers: Mapping[str, Tensor | None]
) -> dict[str, Tensor]:
    """The measures that need more than the photograph, each where it is defined; errors in place of PSNRs."""
    found: dict[str, Tensor] = {}
    if target.foreground is None:
        return found
    found["psnr_foreground"] = squared_error(final, target.photograph, target.foreground)
    if target.reflective is not None:
        found["psnr_reflective"] = squared_error(final, target.photograph, target.reflective)
    normal = layers["normal"]
    if target.normal is not None and normal is not None:
        found["normal_mae_deg"] = normal_mae_deg(normal, target.normal, target.surface)
        found["normal_within_11"] = normal_within_11(normal, target.normal, target.surface)
    for name, true in (("specular", target.specular), ("diffuse", target.diffuse)):
        layer = layers[name]
        if true is not None and layer is not None:
            found[f"{name}_psnr"] = layer_error(layer, true, target.foreground)
            found[f"{name}_psnr_aligned"] = layer_error(layer, true, target.foreground, aligned=True)
    return found


def _numbers(measures: Mapping[str, Tensor]) -> dict[str, float]:
    """What tensors [] hold; the only place where scoring waits for their device."""
    values: list[float] = torch.stack([t.to(torch.float64) for t in measures.values()]).cpu().tolist()
    return dict(zip(measures, values, strict=True))


def _plain(layer: Tensor | None) -> Tensor | None:
    return None if layer is None else layer.detach().to(torch.float64)


def _number(value: object) -> float | None:
    """None for what is not a finite number."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
