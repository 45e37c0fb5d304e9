"""Fresnel's equations for a smooth dielectric, their inverses, and the equations for a smooth conductor.

``zenith`` is the angle of incidence in radians, in [0, pi/2]. Values outside are clamped. ``refractive_index`` is more
than 1. It is a number, or a tensor that broadcasts against the zenith.

All equations are written in ``c = cos i`` and ``t = n cos r = sqrt(n^2 - sin^2 i)`` (Snell's law). In these variables
they are quotients without a singular point between normal and grazing incidence. The textbook forms in ``i - r`` and
``i + r`` are 0/0 at normal incidence.

A conductor has a complex index ``n + i k``, reflects most of the light and has no diffuse lobe. Like the specular
lobe of a dielectric, its reflection is polarized perpendicular to the plane of incidence. The degree of polarization
is small, and no Brewster's angle exists. In ``c`` and ``a + i b = sqrt((n + i k)^2 - sin^2 i)``, the complex
counterpart of ``t``,

    Rs = (a^2 + b^2 + c^2 - 2 a c) / (a^2 + b^2 + c^2 + 2 a c)

    Rp = Rs (x - y sin^2 i) / (x + y sin^2 i),  x = c^2 (a^2 + b^2) + sin^4 i,  y = 2 a c

(the absolute squares of the complex amplitudes; Born and Wolf 1999, Sec. 14.4, give the same quantities).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide.optics._numerics import check_refractive_index, for_arrays, safe_sqrt


def _cosine(zenith: Tensor) -> Tensor:
    # Rounding can make cos(pi/2) negative, and a reflectance larger than 1.
    return torch.cos(zenith.clamp(0, math.pi / 2)).clamp(min=0)


def _refracted(c: Tensor, refractive_index: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return ``t = n cos r`` and ``n^2 c``."""
    check_refractive_index(refractive_index)
    n2 = refractive_index * refractive_index
    return torch.sqrt(n2 - 1 + c * c), n2 * c


@for_arrays
def reflectances_from_cosine(cosine: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Return power reflectances for the cosine of the angle of incidence (Fresnel's equations).

    ``Rs = ((c - t) / (c + t))^2``, ``Rp = ((n^2 c - t) / (n^2 c + t))^2``.

    Args:
        cosine: [...] cos(zenith); negative values (a normal that faces away) count as grazing.
        refractive_index: refractive index of the surface, more than 1.

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
    """Return power reflectances perpendicular (s) and parallel (p) to the plane of incidence (Fresnel's equations).

    ``((n - 1) / (n + 1))^2`` is the value of both at normal incidence. At grazing incidence both are 1.

    Args:
        zenith: [...] angle of incidence, radians.
        refractive_index: refractive index of the surface, more than 1.

    Returns:
        (Rs, Rp), each [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return reflectances_from_cosine(_cosine(zenith), refractive_index)


@for_arrays
def transmittances(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> tuple[Tensor, Tensor]:
    """Return power transmittances through the surface (Fresnel's equations).

    ``Ts = 4 c t / (c + t)^2`` and ``Tp = 4 n^2 c t / (n^2 c + t)^2``. They are equal in both directions, and
    ``R + T = 1`` for each polarization.

    Args:
        zenith: [...] angle outside the dielectric, radians.
        refractive_index: refractive index of the surface, more than 1.

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
    """Return the degrees of polarization of specular and diffuse light over ``sin^2(zenith)``.

    ``rho_s = (Rs - Rp) / (Rs + Rp) = sin^2(i) * 2 c t / (c^2 t^2 + sin^4 i)`` and ``rho_d = u / (2 - u)`` with
    ``u = sin^2(i - r) = sin^2(i) * ((t - c) / n)^2``. Near normal incidence, both are proportional to ``sin^2``, and
    the direction of polarization is undefined at normal incidence itself. Without the factor ``sin^2`` they are smooth.
    Callers multiply them by products of the components of the projected normal, whose squares add up to ``sin^2``. They
    thus avoid the undefined direction.

    Args:
        cosine: [...] cos(zenith); negative values count as grazing.
        refractive_index: refractive index of the surface, more than 1.

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
    """Return the degree of polarization of specularly reflected light, ``(Rs - Rp) / (Rs + Rp)``.

    The incident light is assumed to be unpolarized. The degree is 0 at normal and grazing incidence, and 1 at
    Brewster's angle. The electric field is perpendicular to the plane of incidence.

    Args:
        zenith: [...] radians.
        refractive_index: refractive index of the surface, more than 1.

    Returns:
        [...] in [0, 1].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return dolp_slopes(_cosine(zenith), refractive_index)[0] * torch.sin(zenith.clamp(0, math.pi / 2)) ** 2


@for_arrays
def diffuse_dolp(zenith: Tensor, refractive_index: float | Tensor = 1.5) -> Tensor:
    """Return the degree of polarization of light from below the surface, ``(Tp - Ts) / (Tp + Ts)``.

    The light inside is assumed to be unpolarized. The degree grows from 0 at normal incidence to ``diffuse_dolp_limit``
    at grazing incidence. The electric field lies in the plane of incidence.

    Args:
        zenith: [...] radians.
        refractive_index: refractive index of the surface, more than 1.

    Returns:
        [...] in [0, 1).

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    return dolp_slopes(_cosine(zenith), refractive_index)[1] * torch.sin(zenith.clamp(0, math.pi / 2)) ** 2


@for_arrays
def brewster(refractive_index: float | Tensor = 1.5) -> Tensor:
    """Return Brewster's angle ``atan(n)`` in radians, at which Rp = 0.

    If the refractive index is a number, the result is a float64 scalar tensor.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    if not isinstance(refractive_index, Tensor):
        refractive_index = torch.tensor(refractive_index, dtype=torch.float64)
    return torch.atan(refractive_index)


@for_arrays
def diffuse_dolp_limit(refractive_index: float | Tensor = 1.5) -> float | Tensor:
    """Return the maximum degree of polarization of diffuse light, at grazing incidence: ``(n^2 - 1) / (n^2 + 1)``.

    The result is a number or a tensor, like the refractive index.

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    check_refractive_index(refractive_index)
    n2 = refractive_index * refractive_index
    return (n2 - 1) / (n2 + 1)


@for_arrays
def diffuse_zenith(dolp: Tensor, refractive_index: float | Tensor = 1.5) -> Tensor:
    """Return the zenith at which diffuse light has a given degree of polarization d.

    This is the exact inverse of ``diffuse_dolp``: ``atan2(n sqrt(2d), n sqrt(1 - d) - sqrt(1 + d))``. It follows from
    ``cos^2(i - r) = (1 - d) / (1 + d)`` and Snell's law.

    Args:
        dolp: [...]; clamped to [0, ``diffuse_dolp_limit(refractive_index)``].
        refractive_index: refractive index of the surface, more than 1.

    Returns:
        [...] radians in [0, pi/2]. At d = 0 the gradient is set to 0, although it grows without limit toward this
        point.

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
    """Return the two zeniths at which specular light has a given degree of polarization d.

    They are the inverses of ``specular_dolp``. With ``q = tan i tan r``, Fresnel's equations give ``d = 2q / (1 +
    q^2)``. Hence q is ``d / (1 + sqrt(1 - d^2))`` below Brewster's angle, and the reciprocal of this value above it.
    Then ``x = sin^2 i`` solves ``(1 - q^2) x^2 + q^2 (n^2 + 1) x - q^2 n^2 = 0``. The roots are written with the square
    root in the denominator and computed as tangents, so that no digits cancel at q = 1 (Brewster's angle) and q = 0.

    Args:
        dolp: [...]; clamped to [0, 1].
        refractive_index: refractive index of the surface, more than 1.

    Returns:
        A tuple of the zenith below and the zenith above Brewster's angle, each [...] radians in [0, pi/2]. They are
        equal at d = 1. Gradients are set to 0 at d = 1, and for the zenith below also at d = 0, where they have no
        limit.

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


LEAST_REFLECTANCE = 0.1
"""Lower bound to which ``conductor_index`` clamps reflectances."""
LARGEST_REFLECTANCE = 0.985
"""Upper bound to which ``conductor_index`` clamps reflectances."""


def _terms(cosine: Tensor, n: Tensor, k: Tensor) -> tuple[Tensor, ...]:
    """Return ``c``, ``sin^2 i``, ``a`` and ``a^2 + b^2``."""
    c = cosine.clamp(0, 1)
    sine2 = 1 - c * c
    real = n * n - k * k - sine2
    squared = torch.sqrt(real * real + 4 * (n * k) ** 2)
    larger = torch.sqrt(0.5 * (squared + real.abs()))  # the larger of a and b, which has no cancellation
    return c, sine2, torch.where(real >= 0, larger, n * k / larger), squared


@for_arrays
def conductor_reflectances(cosine: Tensor, n: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """Return power reflectances of a conductor for the cosine of the angle of incidence.

    The module describes the equations.

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        n, k: [...] real and imaginary part of the index, n > 0, k >= 0. With ``k`` = 0 the material is a dielectric.

    Returns:
        (Rs, Rp), each [...] in [0, 1].
    """
    c, sine2, a, squared = _terms(cosine, n, k)
    across = 2 * a * c
    s = (squared + c * c - across) / (squared + c * c + across)
    x = c * c * squared + sine2 * sine2
    return s, s * (x - across * sine2) / (x + across * sine2)


@for_arrays
def conductor_dolp_slope(cosine: Tensor, n: Tensor, k: Tensor) -> Tensor:
    """Return the degree of polarization of a conductor's reflection over ``sin^2(zenith)``.

    ``(Rs - Rp) / (Rs + Rp) = sin^2(i) y / x`` with x and y as defined in the module. The quotient y / x is smooth at
    normal incidence, where the direction of polarization is undefined (compare ``dolp_slopes``).

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        n, k: [...] of the index, n > 0, k >= 0.

    Returns:
        [...], positive.
    """
    c, sine2, a, squared = _terms(cosine, n, k)
    return 2 * a * c / (c * c * squared + sine2 * sine2)


@for_arrays
def conductor_oblique_share(cosine: Tensor, n: Tensor, k: Tensor) -> Tensor:
    """Return the share of polarization at 45 degrees to the plane of incidence that a conductor preserves.

    For incident light that is polarized at 45 degrees, it is the ratio of U / S0 after and before the reflection. It
    equals ``2 Re(-rs rp*) / (|rs|^2 + |rp|^2) = 1 - 2 sin^4(i) / x`` with x as defined in the module. The rest becomes
    circular polarization.

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        n, k: [...] of the index, n > 0, k >= 0.

    Returns:
        [...] in [-1, 1]; 1 at normal incidence, negative beyond the principal angle of incidence.
    """
    c, sine2, _, squared = _terms(cosine, n, k)
    sine4 = sine2 * sine2
    return 1 - 2 * sine4 / (c * c * squared + sine4)


@for_arrays
def conductor_index(reflectance: Tensor) -> tuple[Tensor, Tensor]:
    """Return a typical complex index (n, k) of a metal with a given reflectance r at normal incidence.

    ``n = 2.1 - 1.9 r`` is a line fitted to copper, gold, silver, aluminum, chromium, iron, nickel and titanium. For
    this n, ``k^2 = ((n + 1)^2 r - (n - 1)^2) / (1 - r)`` gives the reflectance r (Gulbrandsen 2014, Eq. 2). The
    resulting degrees of polarization have errors of 0.01 at 45 degrees, 0.08 at 60 degrees and 0.4 beyond 70 degrees.

    Args:
        reflectance: [...] at normal incidence, clamped to [0.1, 0.985].

    Returns:
        (n, k), each [...].
    """
    r = reflectance.clamp(LEAST_REFLECTANCE, LARGEST_REFLECTANCE)
    n = 2.1 - 1.9 * r
    return n, torch.sqrt(((n + 1) ** 2 * r - (n - 1) ** 2) / (1 - r))


@for_arrays
def conductor(cosine: Tensor, reflectance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the reflectance of a metal for unpolarized light, and its ``conductor_dolp_slope``.

    The reflectance is ``(Rs + Rp) / 2``.

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        reflectance: [...] at normal incidence, see ``conductor_index``.

    Returns:
        (R, rho / sin^2), each [...].
    """
    n, k = conductor_index(reflectance)
    s, p = conductor_reflectances(cosine, n, k)
    return 0.5 * (s + p), conductor_dolp_slope(cosine, n, k)
