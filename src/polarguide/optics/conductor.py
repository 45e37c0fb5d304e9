"""Fresnel's equations for a smooth conductor, of complex index ``n + i k``.

A conductor reflects most of the light, has no diffuse lobe, and polarizes what it reflects perpendicular to the plane
of incidence like the specular lobe of a dielectric, but little: there is no Brewster's angle.

In ``c = cos i`` and ``a + i b = sqrt((n + i k)^2 - sin^2 i)``, the complex counterpart of a dielectric's ``n cos r``,

    Rs = (a^2 + b^2 + c^2 - 2 a c) / (a^2 + b^2 + c^2 + 2 a c)
    Rp = Rs (x - y sin^2 i) / (x + y sin^2 i),  x = c^2 (a^2 + b^2) + sin^4 i,  y = 2 a c

(the absolute squares of the complex amplitudes; Born and Wolf 1999, Sec. 14.4, give the same quantities).
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.optics._arrays import for_arrays

# Reflectances at normal incidence for which ``conductor_index`` gives a conductor.
LEAST_REFLECTANCE, LARGEST_REFLECTANCE = 0.1, 0.985


def _terms(cosine: Tensor, n: Tensor, k: Tensor) -> tuple[Tensor, ...]:
    """``c``, ``sin^2 i``, ``a``, ``a^2 + b^2``."""
    c = cosine.clamp(0, 1)
    sine2 = 1 - c * c
    real = n * n - k * k - sine2
    squared = torch.sqrt(real * real + 4 * (n * k) ** 2)
    larger = torch.sqrt(0.5 * (squared + real.abs()))  # of a and b; nothing cancels in it
    return c, sine2, torch.where(real >= 0, larger, n * k / larger), squared


@for_arrays
def conductor_reflectances(cosine: Tensor, n: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """Power reflectances of a conductor from the cosine of the angle of incidence; see the module's text.

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        n, k: [...] real and imaginary part of the index, n > 0, k >= 0; a ``k`` of 0 is a dielectric.

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
    """Degree of polarization of what a conductor reflects, divided by ``sin^2(zenith)``.

    ``(Rs - Rp) / (Rs + Rp) = sin^2(i) y / x`` with x and y of the module's text. It is smooth at normal incidence,
    where the direction of polarization is undefined (compare ``dolp_slopes``).

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        n, k: [...] of the index, n > 0, k >= 0.

    Returns:
        [...], positive.
    """
    c, sine2, a, squared = _terms(cosine, n, k)
    return 2 * a * c / (c * c * squared + sine2 * sine2)


@for_arrays
def conductor_index(reflectance: Tensor) -> tuple[Tensor, Tensor]:
    """An index (n, k) of a metal with this reflectance at normal incidence.

    ``n = 2.1 - 1.9 r``, a line through copper, gold, silver, aluminum, chromium, iron, nickel and titanium, and the
    ``k^2 = ((n + 1)^2 r - (n - 1)^2) / (1 - r)`` that then gives r (Gulbrandsen 2014, Eq. 2). Degrees of polarization
    are right to 0.01 at 45 degrees, to 0.08 at 60 and to 0.4 beyond 70.

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
    """Reflectance for unpolarized light, ``(Rs + Rp) / 2``, and ``conductor_dolp_slope`` of a metal.

    Args:
        cosine: [...] cos(zenith); values outside [0, 1] are clamped.
        reflectance: [...] at normal incidence, as of ``conductor_index``.

    Returns:
        (R, rho / sin^2), each [...].
    """
    n, k = conductor_index(reflectance)
    s, p = conductor_reflectances(cosine, n, k)
    return 0.5 * (s + p), conductor_dolp_slope(cosine, n, k)
