"""Linear Stokes vectors: measurement by polarizers, derived quantities, and their uncertainty.

A Stokes tensor has the three linear components (S0, S1, S2) on its **first** axis and any shape after it. All values
are linear radiance. Angles are radians, zero along the image's horizontal, counter-clockwise as displayed.

An analyzer is a polarizer as one pixel sees it. It transmits the electric field at an angle t in the lens frame of the
pixel, and is represented by (cos 2t, sin 2t). The intensity behind it is ``(S0 + S1 cos 2t + S2 sin 2t) / 2`` (Malus's
law).
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from polarguide.geometry.polarizer import malus, stokes_of_four
from polarguide.geometry.vectors import dot
from polarguide.optics._numerics import check_leading, for_arrays, safe_atan2, safe_sqrt
from polarguide.optics.frames import lens_frame


def stokes(intensities: Tensor) -> Tensor:
    """Return the Stokes vector of four images behind a polarizer at 0, 45, 90 and 135 degrees.

    ``S0 = (I0 + I45 + I90 + I135) / 2``, ``S1 = I0 - I90``, ``S2 = I45 - I135`` (the least-squares solution of Malus's
    law).

    Args:
        intensities: [4, ...] linear intensities in the order of ``ANGLES``. Unsigned integers of 8 or 16 bits are
            divided by the maximum of their type, as in ``read_shot``.

    Returns:
        [3, ...] Stokes vector, in the units of the intensities.

    Raises:
        ValueError: the first axis does not have four entries, or the values are other integers, whose full scale is
            unknown.
    """
    return _stokes(_of_full_scale(intensities))


def _of_full_scale(intensities: Any) -> Any:
    """Divide integers of 8 or 16 bits by their full scale, in single precision. Floats do not change.

    Raises:
        ValueError: the values are other integers.
    """
    kind = getattr(intensities.dtype, "name", str(intensities.dtype).removeprefix("torch."))
    if kind in ("uint8", "uint16"):
        shares = np.asarray(intensities).astype(np.float32) / np.float32(np.iinfo(kind).max)
        return torch.from_numpy(shares) if isinstance(intensities, Tensor) else shares
    if "int" in kind or kind == "bool":
        found = f"found {intensities.dtype}; divide them by full scale"
        raise ValueError(f"intensities: expected floats, or codes of type uint8 or uint16, {found}")
    return intensities


@for_arrays
def _stokes(intensities: Tensor) -> Tensor:
    check_leading(intensities, 4, "intensities")
    return torch.stack(stokes_of_four(intensities.unbind(0)))


@for_arrays
def intensity(stokes: Tensor, angle: float | Tensor) -> Tensor:
    """Return the intensity behind an ideal polarizer by Malus's law, ``(S0 + S1 cos 2a + S2 sin 2a) / 2``.

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
    """Return the degree of linear polarization, ``sqrt(S1^2 + S2^2) / S0``.

    Args:
        stokes: [3, ...].

    Returns:
        [...] in [0, 1]. Larger values, which noise may cause, are clamped. It is 0 if S0 <= 0. The gradient is 0 for
        unpolarized light.
    """
    check_leading(stokes, 3, "stokes")
    s0 = stokes[0]
    live = s0 > torch.finfo(s0.dtype).tiny
    size = torch.where(live, s0, torch.ones_like(s0))
    # |S1|, |S2| <= S0 for physical light; clamping them bounds the quotient and its gradient.
    parts = torch.minimum(torch.maximum(stokes[1:], -size), size) / size
    # Written out, because PyTorch's norm over two components is slow.
    degree = safe_sqrt(parts[0] ** 2 + parts[1] ** 2).clamp(max=1)
    return torch.where(live, degree, torch.zeros_like(degree))


@for_arrays
def aolp(stokes: Tensor) -> Tensor:
    """Return the angle of linear polarization, ``atan2(S2, S1) / 2``: the direction of the electric field.

    Do not average or interpolate these angles. Instead, average Stokes vectors and compute the angle afterwards.

    Args:
        stokes: [3, ...].

    Returns:
        [...] radians in [0, pi); 0 with zero gradient for unpolarized light.
    """
    check_leading(stokes, 3, "stokes")
    angle = safe_atan2(stokes[2], stokes[1]) / 2
    angle = torch.where(angle < 0, angle + math.pi, angle)
    # A tiny negative angle plus pi rounds to pi or, in single precision, above it. It is the angle 0.
    largest = torch.tensor(math.pi, dtype=angle.dtype, device=angle.device)
    return torch.where(angle >= largest, angle - largest, angle)


@for_arrays
def photograph(stokes: Tensor) -> Tensor:
    """Return the picture that a camera would take without a polarizer, ``S0 / 2``.

    This is the mean of the four images behind a polarizer.

    Args:
        stokes: [3, ...].

    Returns:
        [...] linear radiance.
    """
    check_leading(stokes, 3, "stokes")
    return stokes[0] / 2


@for_arrays
def luminance(stokes: Tensor) -> Tensor:
    """Return the mean Stokes vector of the color channels.

    Angles and degrees of polarization of a color picture are computed from this mean and not averaged themselves.

    Args:
        stokes: [3, ..., C] with the colors on the last axis.

    Returns:
        [3, ...].
    """
    check_leading(stokes, 3, "stokes")
    return stokes.mean(dim=-1)


Mount = Literal["sensor", "filter"]
"""Place of the polarizer: on the sensor, or a filter in front of the lens."""


@for_arrays
def filter_analyzer(angle: float | Tensor, rays: Tensor) -> Tensor:
    """Return the analyzer of a filter (sheet polarizer) in front of the lens.

    A filter absorbs the electric field along its absorption axis a, which is parallel to the picture. It transmits the
    field perpendicular to a and to the ray d, along ``d x a``. In the lens frame of a pixel at normalized image
    position (x, y) its angle differs from the mounting angle by up to about ``x y / 2`` radians.

    Args:
        angle: angle of the transmission axis, radians counter-clockwise as displayed; a number or a tensor of one.
        rays: [..., 3] unit, camera axes.

    Returns:
        [2, ...]: cosine and sine of twice the angle of the transmitted field, in the lens frame.
    """
    theta = torch.as_tensor(angle, dtype=rays.dtype, device=rays.device)
    sine = torch.sin(theta)
    cosine = torch.cos(theta)
    x, y, z = rays.unbind(-1)
    # d x a with a = (-sin, -cos, 0): up in the picture is -y of the camera.
    field = torch.stack((z * cosine, -z * sine, y * sine - x * cosine), dim=-1)
    right, up = lens_frame(rays)
    along = dot(field, right)
    across = dot(field, up)
    squared = (along * along + across * across).clamp(min=torch.finfo(rays.dtype).tiny)
    return torch.stack(((along * along - across * across) / squared, 2 * along * across / squared))


@for_arrays
def analyzer(angle: float | Tensor, rays: Tensor, mount: Mount = "sensor") -> Tensor:
    """Return the analyzer of a polarizer at an angle: [2], or [2, ...] for a filter in front of the lens.

    Args:
        angle: angle in radians, a number or a scalar tensor.
        rays: [..., 3] unit directions from the camera, camera axes.
        mount: place of the polarizer.
    """
    if mount == "filter":
        return filter_analyzer(angle, rays)
    twice = 2 * torch.as_tensor(angle, dtype=torch.float64)
    return torch.stack((torch.cos(twice), torch.sin(twice))).to(rays)


@for_arrays
def fitted_stokes(intensities: Tensor, analyzers: Tensor) -> Tensor:
    """Fit Stokes vectors to intensities behind any analyzers by least squares.

    Args:
        intensities: [K, ..., C] linear, of the same exposure, with the colors last.
        analyzers: [K, 2], or [K, 2, ...] if they depend on the pixel. A picture without a polarizer has (0, 0).

    Returns:
        [3, ..., C], in the units of the intensities.

    Raises:
        ValueError: the numbers of analyzers and intensities differ.
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


UNIFORM_SPREAD = math.pi / math.sqrt(12.0)
"""Standard deviation of an unknown angle, in radians (52 degrees)."""


class Uncertainty(NamedTuple):
    """Uncertainty of DoLP and AoLP.

    Attributes:
        dolp: [...] standard deviation of the DoLP; infinite if S0 <= 0.
        aolp: [...] standard deviation of the AoLP in radians, at most ``UNIFORM_SPREAD``.
        debiased: [...] DoLP in [0, 1] without the mean contribution of noise.
    """

    dolp: Tensor
    aolp: Tensor
    debiased: Tensor


@for_arrays
def polarization_uncertainty(stokes: Tensor, variances: Tensor) -> Uncertainty:
    """Return the standard deviations of DoLP and AoLP, and the DoLP without the bias of noise.

    Noise increases the DoLP, so that the measured DoLP of unpolarized light is positive. The debiased DoLP is the
    modified asymptotic estimator ``d - b^2 (1 - exp(-d^2 / b^2)) / (2 d)`` with b the noise across the direction of
    polarization (Plaszczynski, Montier, Levrier and Tristram 2014, "A novel estimator of the polarization amplitude
    from normally distributed Stokes parameters", MNRAS 439, 4048). It is nearly unbiased if d is at least about 2 b.
    For unpolarized light, four fifths of the bias remain. In this case, average Stokes vectors over regions instead.

    Args:
        stokes: [3, ...].
        variances: [4, ...] variances of the independent noise of the four intensities, in the order of ``ANGLES``. The
            units are the squared units of ``stokes``. Shapes that broadcast to [4, ...] are accepted.

    Returns:
        Uncertainty to first order, which is accurate if the DoLP exceeds about three standard deviations. For
        unpolarized light, the AoLP has ``UNIFORM_SPREAD``, and the true standard deviation of the DoLP is 0.66 times
        the returned value.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or the first axis of ``variances`` is not 4.
    """
    check_leading(variances, 4, "variances")
    v0, v45, v90, v135 = variances.unbind(0)
    first = (v0 + v45 + v90 + v135) / 4, (v0 - v90) / 2, (v45 - v135) / 2
    covariance = torch.stack((*first, v0 + v90, torch.zeros_like(v0), v45 + v135))
    return fitted_uncertainty(stokes, covariance)


@for_arrays
def fitted_uncertainty(stokes: Tensor, covariance: Tensor) -> Uncertainty:
    """Return the uncertainty of DoLP and AoLP for fitted Stokes vectors with a known covariance.

    The result is the same as in ``polarization_uncertainty``.

    Args:
        stokes: [3, ...].
        covariance: [6, ...] covariances (S0, S0), (S0, S1), (S0, S2), (S1, S1), (S1, S2) and (S2, S2), in squared
            units of ``stokes``.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or the first axis of ``covariance`` is not 6.
    """
    check_leading(stokes, 3, "stokes")
    check_leading(covariance, 6, "covariance")
    v00, v01, v02, v11, v12, v22 = covariance.unbind(0)
    s0, s1, s2 = stokes.unbind(0)
    tiny = torch.finfo(s0.dtype).tiny
    square = s1 * s1 + s2 * s2
    polarized = square > tiny
    inverse = torch.where(polarized, square, 1.0).rsqrt()
    lit = s0 > tiny
    scale = 1 / torch.where(lit, s0, 1.0)
    # Cosine and sine of twice the AoLP, and the DoLP.
    c = torch.where(polarized, s1 * inverse, 1.0)
    s = s2 * inverse
    d = (torch.where(polarized, square * inverse, 0.0) * scale).clamp(max=1)
    # Variances of S0 times DoLP along the direction of polarization, and across it.
    along = c * c * v11 + 2 * c * s * v12 + s * s * v22 - 2 * d * (c * v01 + s * v02) + d * d * v00
    across = (s * s * v11 - 2 * s * c * v12 + c * c * v22).clamp(min=0)
    b2 = across * scale * scale
    ratio = (d * d / b2.clamp(min=tiny)).clamp(max=88.0)
    bias = b2 * -torch.expm1(-ratio) / (2 * d.clamp(min=1e-12))
    spread = torch.where(polarized, across.sqrt() * (inverse / 2), math.inf).clamp(max=UNIFORM_SPREAD)
    return Uncertainty(
        torch.where(lit, along.clamp(min=0).sqrt() * scale, math.inf),
        torch.where(lit, spread, UNIFORM_SPREAD),
        torch.where(lit, (d - bias).clamp(min=0), 0.0),
    )
