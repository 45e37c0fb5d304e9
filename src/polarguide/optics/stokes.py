"""Linear Stokes vectors, and the quantities derived from them.

A Stokes tensor has the three linear components (S0, S1, S2) on its **first** axis and any shape after it. All
values are linear radiance. Angles are radians, zero along the image's horizontal, counter-clockwise as
displayed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide.optics._arrays import for_arrays
from polarguide.optics._numerics import check_leading, safe_atan2, safe_sqrt
from polarguide.polarizer import malus, stokes_of_four


@for_arrays
def stokes(intensities: Tensor) -> Tensor:
    """Stokes vector of four images taken behind a polarizer at 0, 45, 90 and 135 degrees.

    ``S0 = (I0 + I45 + I90 + I135) / 2``, ``S1 = I0 - I90``, ``S2 = I45 - I135`` (the least-squares solution
    of Malus's law).

    Args:
        intensities: [4, ...] linear intensities in the order of ``ANGLES``.

    Returns:
        [3, ...] Stokes vector, in the units of the intensities.

    Raises:
        ValueError: the first axis does not have four entries.
    """
    check_leading(intensities, 4, "intensities")
    return torch.stack(stokes_of_four(intensities.unbind(0)))


@for_arrays
def intensity(stokes: Tensor, angle: float | Tensor) -> Tensor:
    """Intensity behind an ideal polarizer: Malus's law, ``(S0 + S1 cos 2a + S2 sin 2a) / 2``.

    Args:
        stokes: [3, ...].
        angle: polarizer angle in radians, a number or a tensor that broadcasts against [...].

    Returns:
        [...] intensity.
    """
    check_leading(stokes, 3, "stokes")
    return malus(stokes.unbind(0), torch.as_tensor(angle, dtype=stokes.dtype, device=stokes.device))


@for_arrays
def dolp(stokes: Tensor) -> Tensor:
    """Degree of linear polarization, ``sqrt(S1^2 + S2^2) / S0``.

    Args:
        stokes: [3, ...].

    Returns:
        [...] in [0, 1]: clamped at 1 (noise can exceed it), and 0 where S0 <= 0. The gradient is 0 where the
        light is unpolarized.
    """
    check_leading(stokes, 3, "stokes")
    s0 = stokes[0]
    live = s0 > torch.finfo(s0.dtype).tiny
    size = torch.where(live, s0, torch.ones_like(s0))
    # |S1|, |S2| <= S0 for real light; clamping them first bounds the quotient, and with it the gradient.
    parts = torch.minimum(torch.maximum(stokes[1:], -size), size) / size
    # Written out: torch's norm over two is slow.
    degree = safe_sqrt(parts[0] ** 2 + parts[1] ** 2).clamp(max=1)
    return torch.where(live, degree, torch.zeros_like(degree))


@for_arrays
def aolp(stokes: Tensor) -> Tensor:
    """Angle of linear polarization, ``atan2(S2, S1) / 2``: the direction of the electric field.

    Never average or interpolate these angles; average Stokes vectors and take the angle afterwards.

    Args:
        stokes: [3, ...].

    Returns:
        [...] radians in [0, pi); 0, with zero gradient, where the light is unpolarized.
    """
    check_leading(stokes, 3, "stokes")
    angle = safe_atan2(stokes[2], stokes[1]) / 2
    angle = torch.where(angle < 0, angle + math.pi, angle)
    # A tiny negative angle plus pi rounds to pi, which is the angle 0.
    return torch.where(angle >= math.pi, angle - math.pi, angle)


@for_arrays
def photograph(stokes: Tensor) -> Tensor:
    """The picture without a polarizer on the exposure scale of the four images: their mean, ``S0 / 2``.

    Args:
        stokes: [3, ...].

    Returns:
        [...] linear radiance.
    """
    check_leading(stokes, 3, "stokes")
    return stokes[0] / 2


@for_arrays
def luminance(stokes: Tensor) -> Tensor:
    """Stokes vector of the color channels taken together: their plain mean.

    Angles and degrees of polarization of a color picture are read from this mean; they are not averaged
    themselves.

    Args:
        stokes: [3, ..., C] with the colors on the last axis.

    Returns:
        [3, ...].
    """
    check_leading(stokes, 3, "stokes")
    return stokes.mean(dim=-1)
