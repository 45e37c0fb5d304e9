"""Separation of specular and diffuse light, and prediction of the polarization of their sum.

Both layers are in units of S0, which is twice the intensity of a photograph. The incident light is assumed to be
unpolarized. The surface is assumed to be a smooth dielectric.
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
        specular: [..., C] light reflected at the surface, in units of S0.
        diffuse: [..., C] light from below the surface, in units of S0.
        conditioned: [...] bool, True for pixels with reliable values. It has no color axis.
    """

    specular: Tensor
    diffuse: Tensor
    conditioned: Tensor


def _components(normals: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return three components of the unit normal: toward the camera (cos(zenith)), image right, and image up."""
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
    """Separate specular and diffuse light, given the normal, by solving for S0, S1 and S2.

    By Fresnel's equations, specular light is polarized perpendicular to the plane of incidence with degree rho_s.
    Diffuse light is polarized in this plane with degree rho_d. Let P be the polarization perpendicular to the plane.
    Then ``P = rho_s specular - rho_d diffuse`` and ``S0 = specular + diffuse``. The solution is ``specular = (P + rho_d
    S0) / (rho_s + rho_d)``, clamped to [0, S0], for each color separately.

    Args:
        stokes: [3, ..., C] with the colors last.
        normals: [..., 3] camera axes; only the direction matters.
        rays: [..., 3] unit camera rays.
        refractive_index: refractive index of the surface, more than 1: a number or [...].
        minimum_contrast: lower bound of ``rho_s + rho_d`` for well-conditioned pixels. The default excludes zeniths
            below about 11 degrees at n = 1.5. The divisor is clamped to at least a tenth of this bound, to limit the
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
    """Separate specular and diffuse light as PolarGuide-GSDR does, averaged over the four polarizer angles.

    The specular layer is ``S0 R``, and the diffuse layer is ``S0 (1 - R) T``. R and T are Fresnel's reflectance and
    transmittance, averaged over s and p. The average over the polarizer angles does not change when the camera rolls.
    This separation is coarse. The share of the specular layer depends only on the zenith, and the sum of the layers is
    not S0.

    Args:
        stokes: [3, ..., C] with the colors last.
        zenith: [...] radians.
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        Separation in units of S0. ``conditioned`` is True everywhere.

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
    """Return the intensities of both layers behind a polarizer, as PolarGuide-GSDR defines them.

    The intensity of a layer is ``(Imax + Imin) / 2 + (Imax - Imin) / 2 * cos 2(polarizer - d)``. The specular layer has
    ``Imax = S0 / 2 * Rs``, ``Imin = S0 / 2 * Rp`` and ``d = s_direction``. The diffuse layer has the remaining light in
    place of S0, and Tp and Ts in place of Rs and Rp. Its d is perpendicular to ``s_direction``. (PolarGuide-GSDR has
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
    with both degrees of polarization from Fresnel's equations. It is the inverse of ``exact_separation``. If the normal
    is parallel to the ray, there is no polarization, and value and gradient are smooth. A zero normal also gives no
    polarization. A normal that faces away is treated as grazing.

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
