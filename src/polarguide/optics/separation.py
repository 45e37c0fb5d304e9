"""Separation of specular and diffuse light, and prediction of the polarization of their sum.

Both layers are in units of S0, twice the intensity in a photograph. The incident light is assumed to be unpolarized and
the surface to be a smooth dielectric.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.vectors import dot
from polarguide.optics._numerics import check_leading, for_arrays, safe_normalize
from polarguide.optics.frames import lens_frame
from polarguide.optics.fresnel import dolp_slopes, reflectances, transmittances


class Separation(NamedTuple):
    """Specular and diffuse layer of one picture.

    Attributes:
        specular: [..., C] light reflected at the surface, units of S0.
        diffuse: [..., C] light from below the surface, units of S0.
        conditioned: [...] bool, True for pixels with reliable values; without the color axis.
    """

    specular: Tensor
    diffuse: Tensor
    conditioned: Tensor


def _components(normals: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the components of the unit normal toward the camera (cos(zenith)), image right and image up."""
    unit = safe_normalize(normals)
    x_ref, up_ref = lens_frame(rays)
    return -dot(unit, rays), dot(unit, x_ref), dot(unit, up_ref)


@for_arrays
def exact_separation(
    stokes: Tensor,
    normals: Tensor,
    rays: Tensor,
    refractive_index: float | Tensor = 1.5,
    *,
    minimum_contrast: float = 0.05,
) -> Separation:
    """Solve S1 and S2 for both layers, given the normal.

    Specular light is polarized perpendicular to the plane of incidence with degree rho_s, diffuse light in the plane
    with degree rho_d (Fresnel's equations). With P the part of (S1, S2) along the perpendicular, ``P = rho_s specular
    - rho_d diffuse`` and ``S0 = specular + diffuse``. So ``specular = (P + rho_d S0) / (rho_s + rho_d)``, limited to
    [0, S0], separately for each color.

    Args:
        stokes: [3, ..., C] with the colors last.
        normals: [..., 3] camera axes; only the direction matters.
        rays: [..., 3] unit camera rays.
        refractive_index: refractive index of the surface, more than 1: a number or [...].
        minimum_contrast: lower bound of ``rho_s + rho_d`` for well-conditioned pixels. The default excludes zeniths
            below about 11 degrees at n = 1.5. A tenth of it is the lower bound of the divisor, which limits the
            amplification of noise.

    Returns:
        Separation in units of S0. ``conditioned`` is also False if the normal faces away or is zero.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or ``refractive_index`` is a number not above 1.
    """
    check_leading(stokes, 3, "stokes")
    cosine, x, y = _components(normals, rays)
    specular_slope, diffuse_slope = dolp_slopes(cosine, refractive_index)
    sine2 = 1 - cosine.clamp(0, 1) ** 2
    contrast = (specular_slope + diffuse_slope) * sine2
    s0, s1, s2 = stokes.unbind(0)
    s0 = s0.clamp(min=0)
    # Cosine and sine of twice the azimuth. For an undefined azimuth they and the contrast are 0.
    across = (x * x + y * y).clamp(min=torch.finfo(x.dtype).eps)
    double_cos = (x * x - y * y) / across
    double_sin = 2 * x * y / across
    perpendicular = -(s1 * double_cos[..., None] + s2 * double_sin[..., None])
    specular = perpendicular + (diffuse_slope * sine2)[..., None] * s0
    specular = specular / contrast.clamp(min=minimum_contrast / 10)[..., None]
    specular = torch.minimum(specular.clamp(min=0), s0)
    return Separation(specular, s0 - specular, (contrast >= minimum_contrast) & (cosine > 0))


@for_arrays
def paper_separation(stokes: Tensor, zenith: Tensor, refractive_index: float | Tensor = 1.5) -> Separation:
    """Return the reflection cue of PolarGuide-GSDR, averaged over the four polarizer angles.

    Fresnel's equations divide the observed S0 into specular ``S0 R`` and diffuse ``S0 (1 - R) T``, with R and T the
    means over s and p. The average over the polarizer angles does not change when the camera rolls. The cue is
    coarse: the share of the specular layer depends on the zenith alone, and the sum of the layers is not S0.

    Args:
        stokes: [3, ..., C] with the colors last.
        zenith: [...] radians.
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        Separation in units of S0, ``conditioned`` True everywhere.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or ``refractive_index`` is a number not above 1.
    """
    check_leading(stokes, 3, "stokes")
    rs, rp = reflectances(zenith, refractive_index)
    ts, tp = transmittances(zenith, refractive_index)
    s0 = stokes[0].clamp(min=0)
    reflected = ((rs + rp) / 2)[..., None]
    specular = s0 * reflected
    diffuse = s0 * (1 - reflected) * ((ts + tp) / 2)[..., None]
    return Separation(specular, diffuse, torch.ones_like(zenith, dtype=torch.bool))


@for_arrays
def paper_intensities(
    stokes: Tensor,
    zenith: Tensor,
    s_direction: Tensor,
    polarizer: float | Tensor,
    refractive_index: float | Tensor = 1.5,
) -> tuple[Tensor, Tensor]:
    """Return intensities of both layers behind a polarizer by the reflection cue of PolarGuide-GSDR.

    The intensity of a layer is ``(Imax + Imin) / 2 + (Imax - Imin) / 2 * cos 2(polarizer - d)``. The specular layer has
    ``Imax = S0 / 2 * Rs``, ``Imin = S0 / 2 * Rp`` and ``d = s_direction``. The diffuse layer has the remaining light
    instead of S0, Tp and Ts instead of Rs and Rp, and d perpendicular to ``s_direction``. (PolarGuide-GSDR has
    ``cos 2 theta`` with the angle from the image's x axis, which changes when the camera rolls.) The mean over the four
    polarizer angles is half of ``paper_separation``.

    Args:
        stokes: [3, ..., C] with the colors last.
        zenith: [...] radians.
        s_direction: [...] radians, the direction perpendicular to the plane of incidence: azimuth + pi/2.
        polarizer: radians, a number or [...].
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        (specular, diffuse) intensities, each [..., C].

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or ``refractive_index`` is a number not above 1.
    """
    check_leading(stokes, 3, "stokes")
    rs, rp = reflectances(zenith, refractive_index)
    ts, tp = transmittances(zenith, refractive_index)
    wave = torch.cos(2 * (polarizer - s_direction))
    s0 = stokes[0].clamp(min=0)
    left = s0 * (1 - (rs + rp) / 2)[..., None]
    specular = s0 / 4 * (rs + rp + (rs - rp) * wave)[..., None]
    # The cosine has the opposite sign in the p-direction.
    diffuse = left / 4 * (tp + ts - (tp - ts) * wave)[..., None]
    return specular, diffuse


@for_arrays
def predicted_stokes(
    specular: Tensor, diffuse: Tensor, normals: Tensor, rays: Tensor, refractive_index: float | Tensor = 1.5
) -> Tensor:
    """Predict the measured Stokes vector of two layers on a surface with a known normal.

    ``S0 = specular + diffuse`` and ``(S1, S2) = (rho_s specular - rho_d diffuse) (cos, sin)(2 (azimuth + pi/2))``,
    with both degrees of polarization from Fresnel's equations. It is the inverse of ``exact_separation``. Value and
    gradient are smooth if the normal is parallel to the ray, without polarization. A zero normal has no polarization,
    and a normal that faces away counts as grazing.

    Args:
        specular, diffuse: [..., C] units of S0, the colors last.
        normals: [..., 3] camera axes; only the direction matters.
        rays: [..., 3] unit camera rays.
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        [3, ..., C].

    Raises:
        ValueError: ``refractive_index`` is a number not above 1.
    """
    cosine, x, y = _components(normals, rays)
    specular_slope, diffuse_slope = dolp_slopes(cosine, refractive_index)
    # sin^2, a factor that the slopes lack, times the cosine and sine of twice the azimuth.
    double_cos = x * x - y * y
    double_sin = 2 * x * y
    polarized = diffuse_slope[..., None] * diffuse - specular_slope[..., None] * specular
    s1 = polarized * double_cos[..., None]
    s2 = polarized * double_sin[..., None]
    return torch.stack(torch.broadcast_tensors(specular + diffuse, s1, s2))
