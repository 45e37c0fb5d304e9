"""The angle and the gain of a picture behind a polarizer, in closed form from predicted Stokes vectors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide import optics
from polarguide.optics import Mount

ROUNDS = 6
"""Number of least-squares fits in the approximation of least absolute differences."""
SOFT = 0.001
"""Intensity difference below which the weight of a pixel stays constant."""
FLOOR = 0.02
"""S0 below which the weight of a pixel stays constant."""
BLOCK = 16
"""Side of the squares of pixels whose errors may be correlated."""


@dataclass(frozen=True)
class FittedAngle:
    """Polarizer angle fitted to a picture.

    Attributes:
        angle: degrees in [0, 180), as ``Exposure.angle``.
        gain: brightness over the predicted one.
        modulation: polarization of the picture over the predicted one: 1 behind a polarizer, 0 without a polarizer,
            above 1 if the prediction is too small.
        spread: standard deviation of the angle, degrees; at most 90.
        doubt: standard deviation of the modulation, at most 1.
        misfit: mean residual over the mean light of the picture.
        misfit_across: the same with the polarizer turned by 90 degrees.
    """

    angle: float
    gain: float
    modulation: float
    spread: float
    doubt: float
    misfit: float
    misfit_across: float


def fit_angle(
    intensity: Tensor, stokes: Tensor, weight: Tensor, rays: Tensor, mount: Mount
) -> FittedAngle | None:
    """Fit ``I = (g S0 + x S1 + y S2) / 2`` with g the gain and (x, y) = g (cos 2t, sin 2t) of the angle t.

    Iteratively reweighted least squares minimize the absolute differences over the square of S0. Unexplained light thus
    has little influence on the angle: errors of a prediction grow with the light, and dark surfaces are polarized most.
    A filter in front of the lens has an analyzer that depends on the pixel; there, (x, y) rotates the analyzer of the
    previous round.

    Args:
        intensity: [H, W, 3] linear.
        stokes: [3, H, W, 3] predicted Stokes vectors.
        weight: [H, W], 0 for pixels without a measurement.
        rays: [H, W, 3] unit, camera axes.
        mount: place of the polarizer.

    Returns:
        None without polarization that determines an angle.
    """
    flat = (weight / (stokes[0].mean(dim=-1).clamp(min=0) + FLOOR) ** 2)[..., None].expand_as(intensity)
    plain = flat.reshape(-1).double()
    y = intensity.reshape(-1).double()
    s0, s1, s2 = (part.reshape(-1).double() / 2 for part in stokes)
    angle = 0.0
    weights = plain
    solution = torch.zeros(3, dtype=torch.float64)
    columns = torch.stack((s0, s1, s2))
    for turn in range(ROUNDS):
        if mount == "filter":
            cosine, sine = (
                part[..., None].expand_as(intensity).reshape(-1).double()
                for part in optics.filter_analyzer(angle, rays).unbind(0)
            )
            columns = torch.stack((s0, s1 * cosine + s2 * sine, s2 * cosine - s1 * sine))
        moments = (columns * weights) @ columns.T
        spectrum = torch.linalg.eigvalsh(moments)
        if not torch.isfinite(spectrum).all() or spectrum[0] <= 1e-9 * spectrum[-1].clamp(min=1e-30):
            return None
        solution = torch.linalg.solve(moments, (columns * weights) @ y)
        if mount == "filter":
            angle += math.atan2(float(solution[2]), float(solution[1])) / 2
        if turn < ROUNDS - 1:
            weights = plain / ((y - solution @ columns).abs() + SOFT)
    gain, x, y2 = (float(value) for value in solution)
    if mount == "sensor":
        angle = math.atan2(y2, x) / 2
    length = math.hypot(x, y2)
    if gain <= 0 or length == 0:
        return None
    covariance = _covariance(columns, plain, y - solution @ columns, intensity.shape)
    if mount == "filter":  # turned into the last round's analyzer, which is all but along the first axis
        x = length
        y2 = 0.0
    across = torch.tensor([0.0, -y2, x], dtype=torch.float64) / length
    spread = math.degrees(math.sqrt(max(0.0, float(across @ covariance @ across))) / length / 2)
    doubt = math.sqrt(max(0.0, float(torch.linalg.eigvalsh(covariance[1:, 1:])[-1]))) / gain
    modulation = length / gain
    fair = plain.sqrt()
    light = float((fair * y).sum())
    turned = solution * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    misfit, crossed = (float((fair * (y - of @ columns).abs()).sum()) / light for of in (solution, turned))
    return FittedAngle(
        math.degrees(angle) % 180.0, gain, modulation, min(spread, 90.0), min(doubt, 1.0), misfit, crossed
    )


def _covariance(columns: Tensor, weights: Tensor, residuals: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the covariance [3, 3] of a solution by least absolute differences.

    This is the sandwich estimator. The density of the residuals at zero follows from those below their median. Errors
    may be correlated within blocks of side ``BLOCK``.
    """
    width = residuals[weights > 0].abs().median().clamp(min=1e-9)
    slope = (columns * (weights * (residuals.abs() <= width) / width)) @ columns.T
    scores = (columns * weights * residuals.sign()).reshape(3, *shape).sum(dim=-1)
    blocks = torch.nn.functional.avg_pool2d(scores[None], BLOCK, ceil_mode=True, divisor_override=1)[0]
    sums = blocks.reshape(3, -1)
    inverse = torch.linalg.pinv(slope)
    return inverse @ (sums @ sums.T) @ inverse
