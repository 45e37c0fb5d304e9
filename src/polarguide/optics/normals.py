"""Normals from polarization: candidates, the choice among them, masks of reliable pixels, and color differences.

The polarization of one pixel leaves several possible surface normals. The angle of polarization determines the azimuth
only up to half a turn. Specular and diffuse light are polarized at right angles, which adds an ambiguity of a quarter
turn. Zenith and azimuth are relative to the view ray of the pixel (see ``frames``). All normals are in camera axes.

A dielectric surface reflects light without changing its color, while light from below the surface has the color of the
body. Differences between the color channels of a pixel are therefore mostly diffuse light. Their polarization reveals
the diffuse lobe alone, for any amount of specular light. This combines the two colors of Nayar, Fang and Boult 1997
("Separation of reflection components using color and polarization") with the polarization of diffuse light. In a
channel c of a pixel,

    (S1, S2)_c = (rho_s specular - rho_d diffuse_c) (cos, sin)(2 (azimuth + pi/2)),

so the slope of (S1, S2) over S0 among the channels is ``rho_d (cos, sin)(2 azimuth)``. It determines the azimuth up to
half a turn, without the ambiguity of a quarter turn, and the zenith of the diffuse lobe without the bias of a mixture.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.geometry.vectors import dot
from polarguide.optics._numerics import (
    check_leading,
    check_refractive_index,
    for_arrays,
    safe_atan2,
    safe_normalize,
    safe_sqrt,
    window_mean,
)
from polarguide.optics.frames import normal_from_angles
from polarguide.optics.fresnel import diffuse_dolp_limit, diffuse_zenith, specular_zeniths
from polarguide.optics.stokes import aolp, dolp, luminance


class Candidates(NamedTuple):
    """Four candidate normals of PolarGuide-GSDR.

    Attributes:
        normals: [..., 4, 3] unit: n, -n, R n, -R n, where R turns by 90 degrees about the view axis.
        zenith: [...] zenith of n in radians.
        azimuth: [...] azimuth of n in radians.
    """

    normals: Tensor
    zenith: Tensor
    azimuth: Tensor


class PhysicalCandidates(NamedTuple):
    """Six normals that Fresnel's equations allow for a pixel of one pure lobe.

    Attributes:
        normals: [..., 6, 3] unit normals that face the camera. They are three pairs: diffuse, specular below Brewster's
            angle, and specular above it. The azimuths of a pair differ by half a turn.
        valid: [..., 6] bool. The diffuse pair is False if the degree of polarization exceeds the limit of diffuse
            light. All six are False if S0 is not positive.
        specular: [6] bool, True for candidates of the specular lobe.
    """

    normals: Tensor
    valid: Tensor
    specular: Tensor


class Disambiguated(NamedTuple):
    """Candidate normals that ``disambiguate`` has chosen.

    Attributes:
        normal: [..., 3] unit normal.
        choice: [...] int64 index of the normal among the candidates.
        cosine: [...] cosine between the chosen normal and the guide, in [-1, 1].
    """

    normal: Tensor
    choice: Tensor
    cosine: Tensor


@for_arrays
def paper_candidates(stokes: Tensor, rays: Tensor, refractive_index: float | Tensor = 1.5) -> Candidates:
    """Return four candidate normals as in PolarGuide-GSDR: n, -n, R n, -R n.

    The azimuth of n is the angle of polarization. Its zenith is the zenith at which diffuse light has the measured
    degree of polarization. The formula of this zenith in PolarGuide-GSDR has three misprints. Without them, it equals
    ``diffuse_zenith``.
    Two of the four candidates face away from the camera.

    Args:
        stokes: [3, ...] of the luminance.
        rays: [..., 3] unit camera rays.
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        Candidates.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or ``refractive_index`` is a number not above 1.
    """
    polar = diffuse_zenith(dolp(stokes), refractive_index)
    turn = aolp(stokes)
    normal = normal_from_angles(polar, turn, rays)
    rotated = normal_from_angles(polar, turn + math.pi / 2, rays)
    return Candidates(torch.stack((normal, -normal, rotated, -rotated), dim=-2), polar, turn)


@for_arrays
def physical_candidates(
    stokes: Tensor, rays: Tensor, refractive_index: float | Tensor = 1.5
) -> PhysicalCandidates:
    """Return the six normals that face the camera and explain the polarization by a single pure lobe.

    Two candidates have the diffuse zenith, at the azimuths AoLP and AoLP + pi. Four have one of the two specular
    zeniths, at the azimuths AoLP + pi/2 and AoLP - pi/2.

    Args:
        stokes: [3, ...] of the luminance.
        rays: [..., 3] unit camera rays.
        refractive_index: refractive index of the surface, more than 1: a number or [...].

    Returns:
        PhysicalCandidates. Invalid candidates have the zenith of the nearest possible degree of polarization.

    Raises:
        ValueError: the first axis of ``stokes`` is not 3, or ``refractive_index`` is a number not above 1.
    """
    degree = dolp(stokes)
    angle = aolp(stokes)
    below, above = specular_zeniths(degree, refractive_index)
    polar = torch.stack((diffuse_zenith(degree, refractive_index), below, above), dim=-1)
    polar = polar.repeat_interleave(2, dim=-1)
    turns = torch.tensor((0.0, 1.0, 0.5, -0.5, 0.5, -0.5), dtype=angle.dtype, device=angle.device) * math.pi
    normals = normal_from_angles(polar, angle[..., None] + turns, rays[..., None, :])
    specular = torch.tensor((False, False, True, True, True, True), device=angle.device)
    possible = specular | (degree <= diffuse_dolp_limit(refractive_index))[..., None]
    return PhysicalCandidates(normals, possible & (stokes[0] > 0)[..., None], specular)


@for_arrays
def disambiguate(
    candidates: Candidates | PhysicalCandidates | Tensor,
    guide: Tensor,
    rays: Tensor | None = None,
    *,
    azimuth_weight: float = 0.0,
) -> Disambiguated:
    """Choose the candidate nearest to a guide normal (the cosine rule of PolarGuide-GSDR).

    The score of a candidate is the cosine between the candidate and the guide. With ``azimuth_weight`` w, the score is
    ``(1 - w s) cosine + w s cos(difference of azimuths)``, where s is the sine of the guide's zenith. A wrong
    refractive index or a mixture of lobes changes the zenith of a candidate, but not its azimuth. The azimuth is
    therefore more reliable, unless the guide points to the camera and has no azimuth. Invalid candidates are chosen
    only if all are invalid.

    Args:
        candidates: a record of candidates, or candidate normals [..., K, 3] in camera axes.
        guide: [..., 3] camera axes; only the direction matters. Detach it if it is trained.
        rays: [..., 3] unit camera rays; needed for ``azimuth_weight > 0``.
        azimuth_weight: in [0, 1].

    Returns:
        Disambiguated.

    Raises:
        ValueError: ``azimuth_weight`` is outside [0, 1], or it is positive and ``rays`` is missing.
    """
    if not 0.0 <= azimuth_weight <= 1.0:
        raise ValueError(f"azimuth_weight: expected a number in [0, 1], found {azimuth_weight}")
    normals = candidates if isinstance(candidates, Tensor) else candidates.normals
    guide = safe_normalize(guide)[..., None, :]
    cosines = dot(normals, guide)
    score = cosines
    if azimuth_weight > 0.0:
        if rays is None:
            raise ValueError("rays: expected the camera rays, since azimuth_weight is positive, found None")
        axis = rays[..., None, :]
        guide_across = guide - dot(guide, axis)[..., None] * axis
        across = safe_normalize(normals - dot(normals, axis)[..., None] * axis)
        weight = azimuth_weight * safe_sqrt(dot(guide_across, guide_across))
        # |guide_across| is the sine of the zenith, so the second term below is w * s * cos(difference of
        # azimuths).
        score = (1 - weight) * cosines + azimuth_weight * dot(across, guide_across)
    if isinstance(candidates, PhysicalCandidates):
        score = torch.where(candidates.valid, score, score - 4)
    choice = score.argmax(dim=-1)
    normal = torch.take_along_dim(normals, choice[..., None, None], dim=-2).squeeze(-2)
    cosine = torch.take_along_dim(cosines, choice[..., None], dim=-1).squeeze(-1)
    return Disambiguated(normal, choice, cosine)


@for_arrays
def dolp_noise(stokes: Tensor, noise_sigma: float | Tensor) -> Tensor:
    """Return the standard deviation of the degree of polarization d for independent noise on the four intensities.

    If each intensity has the standard deviation ``sigma``, S1 and S2 have ``sqrt(2) sigma``, and S0 has ``sigma``. S0
    is uncorrelated with S1 and S2. To first order, d has the standard deviation ``sigma sqrt(2 + d^2) / S0``, which is
    ``sqrt(2) sigma / S0`` for weakly polarized light. For unpolarized light the measured d has a Rayleigh distribution
    with this scale: its mean is 1.25 scales, and 1.1 % of the pixels exceed 3 scales.

    Args:
        stokes: [3, ...].
        noise_sigma: standard deviation of one of the four intensities in the units of ``stokes``, a number or [...].
            The mean over three colors with independent noise has 1/sqrt(3) of the value of one channel.

    Returns:
        [...]; infinite if S0 <= 0 and the noise is positive.
    """
    check_leading(stokes, 3, "stokes")
    s0 = stokes[0].clamp(min=0)
    spread = noise_sigma * torch.sqrt(2 + dolp(stokes) ** 2)
    return torch.where(s0 > 0, spread / torch.where(s0 > 0, s0, torch.ones_like(s0)), spread * math.inf)


@for_arrays
def intensity_noise(intensities: Tensor, window: int = 15) -> Tensor:
    """Estimate the standard deviation of the noise of one of the four intensities from the pictures.

    Four angles measure three unknowns, so ``I0 + I90 - I45 - I135`` is zero without noise. Its variance is four times
    the variance of the noise. The variance is computed about the mean over the window, so that unequal gains of the
    angles are not mistaken for noise. Changes of the light between shots count as noise.

    Args:
        intensities: [4, H, W], of one channel or of the mean over the colors.
        window: odd side of the window in pixels.

    Returns:
        [H, W] in the units of the intensities.

    Raises:
        ValueError: ``intensities`` is not [4, H, W], or ``window`` is not a positive odd number.
    """
    check_leading(intensities, 4, "intensities")
    if intensities.ndim != 3:
        raise ValueError(f"intensities: expected shape [4, H, W], found {list(intensities.shape)}")
    i0, i45, i90, i135 = intensities.unbind(0)
    excess = i0 + i90 - i45 - i135
    mean, square = window_mean(torch.stack((excess, excess**2)), window).unbind(0)
    return safe_sqrt(square - mean**2) / 2


@for_arrays
def polarization_mask(
    stokes: Tensor,
    *,
    threshold: float = 0.05,
    invalid: Tensor | None = None,
    noise_sigma: float | Tensor = 0.0,
    snr: float = 3.0,
    saturated: Tensor | None = None,
) -> Tensor:
    """Return a mask of pixels whose polarization is strong and certain enough to estimate a normal.

    Args:
        stokes: [3, ...] of the luminance.
        threshold: exclusive lower bound of the degree of polarization.
        invalid: [...] bool, pixels without data.
        noise_sigma: standard deviation of one of the four intensities, see ``dolp_noise``; 0 disables the noise test.
        snr: exclusive lower bound of the degree of polarization over its noise.
        saturated: [...] bool, pixels that are clipped in one of the four images.

    Returns:
        [...] bool; False if S0 <= 0.
    """
    degree = dolp(stokes)
    mask = (degree > threshold) & (stokes[0] > 0)
    if isinstance(noise_sigma, Tensor) or noise_sigma > 0:
        mask = mask & (degree > snr * dolp_noise(stokes, noise_sigma))
    for bad in (invalid, saturated):
        if bad is not None:
            mask = mask & ~bad
    return mask


class ChromaticNormals(NamedTuple):
    """Normals from the polarization of color differences, as angles.

    The slope is the slope of (S1, S2) over S0 among colors, see ``chromatic_normals``.

    Attributes:
        zenith: [H, W] zenith in radians. There, the degree of polarization of diffuse light equals the length of the
            slope.
        azimuth: [H, W] azimuth in radians in (-pi/2, pi/2]. It is ambiguous by half a turn.
        certainty: [H, W] ratio of the standard deviations of explained and unexplained polarization; 0 without color.
        decided: [H, W] bool, True if only diffuse light can explain the slope.
        contrast: [H, W] standard deviation of S0 among the colors of the window, as a share of S0.
    """

    zenith: Tensor
    azimuth: Tensor
    certainty: Tensor
    decided: Tensor
    contrast: Tensor


@for_arrays
def chromatic_normals(
    stokes: Tensor,
    refractive_index: float = 1.5,
    *,
    window: int = 5,
    minimum_certainty: float = 1.5,
    minimum_contrast: float = 0.05,
    pure_lobe_dolp: float = 0.05,
) -> ChromaticNormals:
    """Estimate zenith and azimuth from the slope of (S1, S2) over S0 among the colors of a small window.

    For diffuse color differences, the slope is ``rho_d`` times the direction of diffuse polarization. A colored
    reflection has a slope of ``rho_s`` times the opposite direction. The mean polarization distinguishes both cases. If
    it is opposite to the slope, the pixel contains both lobes. The lobe that differs between colors is then the more
    weakly polarized lobe, which is the diffuse lobe. If the mean polarization is parallel to the slope, the pixel may
    be a single colored lobe of either kind. Such a pixel is decided only if its degree of polarization is small, as
    diffuse light has at most zeniths.

    Args:
        stokes: [3, H, W, C] with the colors last.
        refractive_index: refractive index of the surface, more than 1.
        window: odd side of the window in pixels; the surface should be flat over it.
        minimum_certainty: least ``certainty`` of a decided pixel.
        minimum_contrast: least ``contrast`` of a decided pixel.
        pure_lobe_dolp: largest degree of polarization of a decided pixel whose mean polarization is parallel to the
            slope.

    Returns:
        ChromaticNormals. A picture without color has no decided pixel.

    Raises:
        ValueError: ``stokes`` is not [3, H, W, C], ``window`` is even, or ``refractive_index`` is not above 1.
    """
    check_leading(stokes, 3, "stokes")
    check_refractive_index(refractive_index)
    if stokes.ndim != 4:
        raise ValueError(f"stokes: expected shape [3, H, W, C], found {list(stokes.shape)}")
    mean = luminance(stokes)
    d0, d1, d2 = (stokes - mean[..., None]).movedim(-1, 1)
    moments = torch.stack([(a * b).mean(dim=0) for a, b in ((d0, d0), (d0, d1), (d0, d2))])
    spread = (d1 * d1 + d2 * d2).mean(dim=0)
    moments = window_mean(torch.cat((moments, spread[None], mean)), window)
    variance, slope1, slope2, spread, s0, s1, s2 = moments.unbind(0)
    least = torch.finfo(variance.dtype).tiny
    slope1 = slope1 / variance.clamp(min=least)
    slope2 = slope2 / variance.clamp(min=least)
    degree = torch.hypot(slope1, slope2)
    explained = degree * variance.sqrt()
    unexplained = (spread - explained**2).clamp(min=0).sqrt()
    # Rounding errors of a picture without color must not count as color.
    colored = variance.sqrt() > minimum_contrast * s0
    certainty = torch.where(colored, explained / unexplained.clamp(min=1e-6 * s0.abs() + least), 0.0)
    limit = diffuse_dolp_limit(refractive_index)
    against = slope1 * s1 + slope2 * s2 < 0
    decided = colored & (certainty >= minimum_certainty) & (degree < 0.95 * limit)
    decided = decided & (against | (dolp(mean) < pure_lobe_dolp))
    zenith = diffuse_zenith(degree.clamp(max=limit), refractive_index)
    contrast = variance.sqrt() / s0.clamp(min=least)
    return ChromaticNormals(zenith, safe_atan2(slope2, slope1) / 2, certainty, decided, contrast)
