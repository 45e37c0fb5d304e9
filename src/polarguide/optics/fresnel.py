"""Fresnel's equations for a smooth dielectric, and their inverses.

``zenith`` is the angle of incidence in radians, in [0, pi/2] (values outside are clamped); ``refractive_index``
is more than 1, a number or a tensor that broadcasts against the zenith.

Everything is written in ``c = cos i`` and ``t = n cos r = sqrt(n^2 - sin^2 i)`` (Snell's law). In these
variables the equations are quotients without a singular point between normal and grazing incidence, whereas
the textbook forms in ``i - r`` and ``i + r`` are 0/0 at normal incidence.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide.optics._arrays import for_arrays
from polarguide.optics._numerics import check_refractive_index, safe_sqrt


def _cosine(zenith: Tensor) -> Tensor:
    # In floating point cos(pi/2) can be a little below zero; a reflectance above 1 would follow.
    return torch.cos(zenith.clamp(0, math.pi / 2)).clamp(min=0)


def _refracted(c: Tensor, refractive_index: float | Tensor) -> tuple[Tensor, Tensor]:
    """``t = n cos r`` and ``n^2 c``."""
    check_refractive_index(refractive_index)
    n2 = refractive_index * refractive_index
    return torch.sqrt(n2 - 1 + c * c), n2 * c


@for_arrays
def reflectances_from_cosine(cosine: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Power reflectances from the cosine of the angle of incidence (Fresnel's equations).

    ``Rs = ((c - t) / (c + t))^2``, ``Rp = ((n^2 c - t) / (n^2 c + t))^2``.

    Args:
        cosine: [...] cos(zenith); negative values (a normal that faces away) count as grazing.
        refractive_index: of the surface, more than 1.

    Returns:
        (Rs, Rp), each [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    c = cosine.clamp(min=0)
    t, p = _refracted(c, refractive_index)
    return ((c - t) / (c + t)) ** 2, ((p - t) / (p + t)) ** 2


@for_arrays
def reflectances(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Power reflectances perpendicular (s) and parallel (p) to the plane of incidence (Fresnel's equations).

    ``((n - 1) / (n + 1))^2`` for both at normal incidence, 1 for both at grazing incidence.

    Args:
        zenith: [...] angle of incidence, radians.
        refractive_index: of the surface, more than 1.

    Returns:
        (Rs, Rp), each [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return reflectances_from_cosine(_cosine(zenith), refractive_index)


@for_arrays
def transmittances(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Power transmittances (Ts, Tp) through the surface, ``4 c t / (c + t)^2`` and
    ``4 n^2 c t / (n^2 c + t)^2``.

    They are the same in both directions, and ``R + T = 1`` for each polarization.

    Args:
        zenith: [...] angle outside the dielectric, radians.
        refractive_index: of the surface, more than 1.

    Returns:
        (Ts, Tp), each [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    c = _cosine(zenith)
    t, p = _refracted(c, refractive_index)
    return 4 * c * t / (c + t) ** 2, 4 * p * t / (p + t) ** 2


@for_arrays
def dolp_slopes(cosine: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Degrees of polarization of both lobes divided by ``sin^2(zenith)``, from the cosine of the zenith.

    ``rho_s = (Rs - Rp) / (Rs + Rp) = sin^2(i) * 2 c t / (c^2 t^2 + sin^4 i)`` and ``rho_d = u / (2 - u)``
    with ``u = sin^2(i - r) = sin^2(i) * ((t - c) / n)^2``. Both vanish as ``sin^2`` at normal incidence,
    where the direction of polarization is undefined; without that factor they are smooth, so a caller that
    multiplies by the components of the projected normal (whose squares sum to ``sin^2``) never meets the
    singular direction.

    Args:
        cosine: [...] cos(zenith); negative values count as grazing.
        refractive_index: of the surface, more than 1.

    Returns:
        (rho_s / sin^2, rho_d / sin^2), each [...], positive.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    c = cosine.clamp(0, 1)
    sine2 = 1 - c * c
    t = torch.sqrt(refractive_index * refractive_index - sine2)
    specular = 2 * c * t / (c * c * t * t + sine2 * sine2)
    slope = ((t - c) / refractive_index) ** 2
    return specular, slope / (2 - sine2 * slope)


@for_arrays
def specular_dolp(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> Tensor:
    """Degree of polarization of specularly reflected light, ``(Rs - Rp) / (Rs + Rp)``.

    The incident light is unpolarized. 0 at normal and grazing incidence, 1 at Brewster's angle; the field is
    perpendicular to the plane of incidence.

    Args:
        zenith: [...] radians.
        refractive_index: of the surface, more than 1.

    Returns:
        [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return dolp_slopes(_cosine(zenith), refractive_index)[0] * torch.sin(zenith.clamp(0, math.pi / 2)) ** 2


@for_arrays
def diffuse_dolp(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> Tensor:
    """Degree of polarization of light that leaves from below the surface, ``(Tp - Ts) / (Tp + Ts)``.

    The light is unpolarized inside. It grows from 0 at normal incidence to ``diffuse_dolp_limit`` at grazing;
    the field lies in the plane of incidence.

    Args:
        zenith: [...] radians.
        refractive_index: of the surface, more than 1.

    Returns:
        [...] in [0, 1).

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return dolp_slopes(_cosine(zenith), refractive_index)[1] * torch.sin(zenith.clamp(0, math.pi / 2)) ** 2


@for_arrays
def brewster(refractive_index: float | Tensor = 1.5) -> Tensor:
    """Brewster's angle ``atan(n)`` in radians, where Rp = 0.

    A number gives a float64 scalar tensor.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    if not isinstance(refractive_index, Tensor):
        refractive_index = torch.tensor(refractive_index, dtype=torch.float64)
    return torch.atan(refractive_index)


@for_arrays
def diffuse_dolp_limit(refractive_index: float | Tensor = 1.5) -> float | Tensor:
    """Largest degree of polarization that diffuse light reaches (at grazing): ``(n^2 - 1) / (n^2 + 1)``.

    A number for a number, a tensor for a tensor.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    n2 = refractive_index * refractive_index
    return (n2 - 1) / (n2 + 1)


@for_arrays
def diffuse_zenith(dolp: Tensor, refractive_index: float | Tensor = 1.5) -> Tensor:
    """Zenith at which diffuse light has this degree of polarization: the exact inverse of ``diffuse_dolp``.

    ``atan2(n sqrt(2d), n sqrt(1 - d) - sqrt(1 + d))``, from ``cos^2(i - r) = (1 - d) / (1 + d)`` and Snell's
    law.

    Args:
        dolp: [...]; clamped to [0, ``diffuse_dolp_limit(refractive_index)``].
        refractive_index: of the surface, more than 1.

    Returns:
        [...] radians in [0, pi/2]. The gradient, infinite in the limit of d = 0, is 0 at d = 0 itself.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    limit = torch.as_tensor(diffuse_dolp_limit(refractive_index), dtype=dolp.dtype, device=dolp.device)
    d = torch.minimum(dolp.clamp(min=0), limit)
    angle = torch.atan2(
        refractive_index * safe_sqrt(2 * d), refractive_index * torch.sqrt(1 - d) - torch.sqrt(1 + d)
    )
    return angle.clamp(max=math.pi / 2)


@for_arrays
def specular_zeniths(dolp: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """The two zeniths at which specular light has this degree of polarization: inverses of ``specular_dolp``.

    With ``q = tan i tan r`` Fresnel's equations give ``d = 2q / (1 + q^2)``, hence
    ``q = d / (1 + sqrt(1 - d^2))`` below Brewster's angle and its reciprocal above. ``sin^2 i`` then solves
    ``(1 - q^2) x^2 + q^2 (n^2 + 1) x - q^2 n^2 = 0``; the roots are written with the square root in the
    denominator, where nothing cancels at q = 1 (Brewster) nor at q = 0, and given as tangents.

    Args:
        dolp: [...]; clamped to [0, 1].
        refractive_index: of the surface, more than 1.

    Returns:
        (below, above) Brewster's angle, each [...] radians in [0, pi/2]; equal at d = 1. Gradients, infinite
        in the limits of d = 0 (below) and d = 1, are 0 at these points themselves.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    d = dolp.clamp(0, 1)
    q = d / (1 + safe_sqrt((1 - d) * (1 + d)))
    n2 = refractive_index * refractive_index
    root = torch.sqrt((n2 - 1) ** 2 * q * q + 4 * n2)
    below = torch.atan(safe_sqrt(q * (root + (n2 - 1) * q) / 2))
    root = torch.sqrt((n2 - 1) ** 2 + 4 * n2 * q * q)
    above = torch.atan2(torch.sqrt(2 * (root + n2 - 1)), 2 * q)
    return below, above
