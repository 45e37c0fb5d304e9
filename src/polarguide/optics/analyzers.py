"""Polarizers at any angle: which component of the light each one passes, and Stokes vectors from their intensities.

An analyzer is the pair (cos 2t, sin 2t) of the angle t, in the lens frame of its pixel, of the field that it passes:
its intensity is ``(S0 + S1 cos 2t + S2 sin 2t) / 2`` (Malus's law).
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from polarguide.optics._arrays import for_arrays
from polarguide.optics._numerics import check_leading
from polarguide.optics.frames import lens_frame
from polarguide.vectors import dot

Mount = Literal["sensor", "filter"]
"""Where the polarizer is: behind the lens, or a sheet before it."""


@for_arrays
def filter_analyzer(angle: float | Tensor, rays: Tensor) -> Tensor:
    """Analyzer of a sheet polarizer before the lens.

    A sheet absorbs the field along its absorption axis a, which lies in the plane of the picture, and passes what is
    perpendicular to a and to the ray d: the field ``d x a``. In the lens frame of a pixel at normalized image position
    (x, y) that is up to about ``x y / 2`` radians away from the angle at which the sheet is mounted.

    Args:
        angle: of the transmission axis, radians counter-clockwise as displayed; a number or a tensor of one.
        rays: [..., 3] unit, camera axes.

    Returns:
        [2, ...]: cosine and sine of twice the angle of the field that it passes, in the lens frame.
    """
    theta = torch.as_tensor(angle, dtype=rays.dtype, device=rays.device)
    sine, cosine = torch.sin(theta), torch.cos(theta)
    x, y, z = rays.unbind(-1)
    # d x a with a = (-sin, -cos, 0): up in the picture is -y of the camera.
    passed = z * cosine, -z * sine, y * sine - x * cosine
    right, up = lens_frame(rays)
    field = torch.stack(passed, dim=-1)
    along, across = dot(field, right), dot(field, up)
    squared = (along * along + across * across).clamp(min=torch.finfo(rays.dtype).tiny)
    return torch.stack(((along * along - across * across) / squared, 2 * along * across / squared))


@for_arrays
def analyzer(angle: float | Tensor, rays: Tensor, mount: Mount = "sensor") -> Tensor:
    """Analyzer of a polarizer at an angle: [2], or [2, ...] of a filter before the lens.

    Args:
        angle: radians, a number or a tensor of one. rays: [..., 3] unit, camera axes.
        mount: where the polarizer is.
    """
    if mount == "filter":
        return filter_analyzer(angle, rays)
    twice = 2 * torch.as_tensor(angle, dtype=torch.float64)
    return torch.stack((torch.cos(twice), torch.sin(twice))).to(rays)


@for_arrays
def fitted_stokes(intensities: Tensor, analyzers: Tensor) -> Tensor:
    """Least-squares Stokes vectors of intensities behind any analyzers.

    Args:
        intensities: [K, ..., C] linear, on one exposure, with the colors last.
        analyzers: [K, 2], or [K, 2, ...] of each pixel; (0, 0) for a picture without a polarizer.

    Returns:
        [3, ..., C], in the units of the intensities.

    Raises:
        ValueError: there are not as many analyzers as intensities.
    """
    check_leading(intensities, len(analyzers), "intensities")
    ones = torch.ones_like(analyzers[:, :1])
    rows = torch.cat((ones, analyzers), dim=1).to(torch.float64) / 2
    if rows.ndim == 2:
        inverse = torch.linalg.pinv(rows).to(intensities)
        return torch.einsum("sk,k...->s...", inverse, intensities)
    rows = rows.movedim((0, 1), (-2, -1))
    moments = torch.linalg.inv(rows.mT @ rows) @ rows.mT
    return torch.einsum("...sk,k...c->s...c", moments.to(intensities), intensities)
