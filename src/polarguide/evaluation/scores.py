"""Scores of one rendered view, and their means over views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypedDict

import torch
from torch import Tensor

from .lpips import lpips
from .metrics import layer_psnr, normal_mae_deg, normal_within_11, psnr, reflective_mask, ssim

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


def score_view(truth: Tensor, invalid: Tensor | None, ground_truth: Any, rendered: Any) -> ViewScores:
    """Score one rendered view.

    Args:
        truth: [H, W, 3] linear, the photograph S0/2.
        invalid: [H, W] bool, pixels of the photograph that do not count (saturated, dark, no data); None: all
            count. It applies to every score.
        ground_truth: None, or an object whose attributes may each be None: ``mask`` [H, W] bool, ``normal``
            [H, W, 3] world, ``specular`` and ``diffuse`` [H, W, 3] linear S0 of the lobes.
        rendered: an object with ``final`` [H, W, 3] linear, and, each None where the recipe has no such
            layer, ``normal`` [H, W, 3] world of any length, ``specular`` and ``diffuse`` [H, W, 3] linear
            contributions to the final picture.

    Returns:
        Every per-view key. PSNRs are at most ``PERFECT_PSNR``.

    Raises:
        ValueError: shapes that do not fit.
    """
    valid = torch.ones(truth.shape[:2], dtype=torch.bool) if invalid is None else ~invalid.cpu()
    truth = _plain(truth)
    layers = {name: _plain(getattr(rendered, name)) for name in ("final", "normal", "specular", "diffuse")}
    broken = torch.zeros_like(valid)
    for name, layer in layers.items():
        if layer is not None:
            lost = ~layer.isfinite().all(-1)
            broken |= lost
            layers[name] = torch.where(lost[..., None], 0.0, layer)
    final = layers["final"]
    distance, reason = lpips(final, truth, None if invalid is None else valid)
    scores: ViewScores = {
        "psnr": finite_psnr(psnr(final, truth, valid)),
        "ssim": _number(ssim(final, truth, valid)),
        "lpips": distance,
        "lpips_reason": reason,
    }
    scores.update(_scores_against_scene(truth, valid, ground_truth, layers))
    if broken.any():
        scores["nonfinite_pixels"] = int(broken.sum())
    return scores


def summarise(per_view: Mapping[str, ViewScores]) -> dict[str, float | str | None]:
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


def _scores_against_scene(
    truth: Tensor, valid: Tensor, ground_truth: Any, layers: Mapping[str, Tensor | None]
) -> ViewScores:
    """The keys that need more than the photograph."""
    final = layers["final"]
    assert final is not None
    mask, normal, specular, diffuse = (
        _plain(getattr(ground_truth, name, None)) for name in ("mask", "normal", "specular", "diffuse")
    )
    scores: ViewScores = {key: None for key in MEAN_KEYS if key not in PICTURE_KEYS}  # type: ignore
    if mask is None:
        return scores
    keep = mask.to(torch.bool) & valid
    scores["psnr_foreground"] = finite_psnr(psnr(final, truth, keep))
    if specular is not None:
        reflective = reflective_mask(specular, 2 * truth, keep)
        scores["psnr_reflective"] = finite_psnr(psnr(final, truth, reflective))
    if normal is not None and layers["normal"] is not None:
        scores["normal_mae_deg"] = _number(normal_mae_deg(layers["normal"], normal, keep))
        scores["normal_within_11"] = _number(normal_within_11(layers["normal"], normal, keep))
    for name, true in (("specular", specular), ("diffuse", diffuse)):
        layer = layers[name]
        if true is None or layer is None:
            continue
        scores[f"{name}_psnr"] = finite_psnr(layer_psnr(layer, true, keep))  # type: ignore[literal-required]
        aligned = finite_psnr(layer_psnr(layer, true, keep, aligned=True))
        scores[f"{name}_psnr_aligned"] = aligned  # type: ignore[literal-required]
    return scores


def _plain(value: Any) -> Any:
    """A tensor on the CPU in float64, so that every device gives one number; None stays None."""
    return None if value is None else torch.as_tensor(value).detach().to("cpu", torch.float64)


def _number(value: object) -> float | None:
    """None for what is not a finite number."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
