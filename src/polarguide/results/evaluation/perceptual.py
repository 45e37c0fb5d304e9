"""Learned and perceptual distances of two pictures, where their packages and weights are installed: LPIPS and FLIP."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.optics.color import shown
from polarguide.results.evaluation.vgg import load_lpips

# Five halvings: below this the last layer of the network has no pixel.
MINIMUM_SIZE = 32


def lpips(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Learned perceptual distance of two shown pictures.

    The network reads whole pictures, so pixels outside ``keep`` are set to the true picture in both.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels that count; None counts all.

    Returns:
        (distance, None), the distance 0 for equal pictures and smaller for more alike ones; or (None, reason)
        where the weights are not there or a picture is smaller than 32 pixels.
    """
    if min(pred_linear.shape[:2]) < MINIMUM_SIZE:
        return None, f"the picture is smaller than {MINIMUM_SIZE} x {MINIMUM_SIZE} pixels"
    distance, reason = load_lpips()
    if distance is None:
        return None, reason
    device = pred_linear.device
    true = true_linear.to(device)
    if keep is not None:
        counts = keep.to(device)[..., None]
        true = torch.where(counts, true, true.nan_to_num())
        pred_linear = torch.where(counts, pred_linear, true)
    return distance.to(device)(shown(pred_linear), shown(true)), None


PIXELS_PER_DEGREE = 67.0206
"""Of the visual angle: a display of 3840 pixels, 0.7 m wide, seen from 0.7 m, as the authors report it."""
PACKAGE = "flip-evaluator"


def flip(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Mean LDR-FLIP of two shown pictures (Andersson et al. 2020) at ``PIXELS_PER_DEGREE``.

    The eye's filters reach beyond a pixel, so pixels outside ``keep`` are black in both, and the mean is taken over the
    others.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels that count; None counts all.

    Returns:
        (value, None), the value from 0 for equal pictures to 1; or (None, reason) where the package is not installed or
        no pixel counts.
    """
    package, reason = load_package()
    if package is None:
        return None, reason
    true = true_linear.detach().cpu()
    pred = pred_linear.detach().cpu().to(true.dtype)
    counts = torch.ones(true.shape[:2], dtype=torch.bool) if keep is None else keep.cpu()
    if not counts.any():
        return None, "no pixel counts"
    encoded = [
        torch.where(counts[..., None], shown(picture), 0.0).float().contiguous().numpy()
        for picture in (true, pred)
    ]
    errors, _, _ = package.evaluate(
        *encoded, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": PIXELS_PER_DEGREE}
    )
    return float(torch.from_numpy(errors[..., 0].copy())[counts].double().mean()), None


@lru_cache(maxsize=1)
def load_package() -> tuple[Any, str | None]:
    """The package ``flip_evaluator``, loaded once per process: (package, None), or (None, reason)."""
    try:
        return optional_import("flip_evaluator", "FLIP"), None
    except PolarguideError:
        return None, f"the package {PACKAGE} is not installed"
