"""What a held-out picture behind a polarizer is compared with, where S0 was not measured."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide import optics
from polarguide.angles.fit import fit_angle
from polarguide.capture import View
from polarguide.optics import Mount


@torch.no_grad()
def cross_fitted(view: View, final: Tensor, stokes: Tensor | None) -> Tensor:
    """The picture that a model predicts of ``view.photograph()``, behind an analyzer that is fitted on the other half.

    Gain, angle and strength of the analyzer are fitted on the left half of the picture for the right one, and on the
    right one for the left (``angles.fit``), so that no pixel takes part in the fit that it is scored by.

    Args:
        view: whose pictures do not measure S0.
        final: [H, W, 3] rendered, S0/2.
        stokes: [3, H, W, 3] as predicted; None: no prediction, the gain alone is fitted.

    Returns:
        [H, W, 3] linear, on the device of ``final``.
    """
    local = view.to(final.device)
    measured, rays = local.photograph().to(final), local.camera.rays(device=final.device)
    good = (~(local.invalid | local.saturated)).to(final)
    polarized = torch.zeros_like(final).expand(2, *final.shape) if stokes is None else stokes[1:]
    predicted = torch.cat((2 * final[None], polarized)).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    left = torch.arange(final.shape[1], device=final.device) < final.shape[1] // 2
    by_right, by_left = (
        _behind(measured, predicted, good * half, rays, view.mount) for half in (~left, left)
    )
    return torch.where(left[None, :, None], by_right, by_left)


def _behind(measured: Tensor, stokes: Tensor, weight: Tensor, rays: Tensor, mount: Mount) -> Tensor:
    """The whole picture behind the analyzer that fits where the weight is."""
    found = fit_angle(measured, stokes, weight, rays, mount)
    if found is None:
        counted = weight[..., None]
        gain = (counted * measured).sum() / (counted * stokes[0] / 2).sum().clamp(min=1e-12)
        return gain * stokes[0] / 2
    cosine, sine = optics.analyzer(math.radians(found.angle), rays, mount)[..., None].to(stokes)
    polarized = found.modulation * (stokes[1] * cosine + stokes[2] * sine)
    return found.gain * (stokes[0] + polarized) / 2
