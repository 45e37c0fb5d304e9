"""Normals from the polarization of color differences.

Light reflected at a dielectric surface has nearly the color of what it reflects; light from below has the
color of the body. Between the color channels of a pixel it is therefore mostly diffuse light that differs,
and how polarization differs with it shows the diffuse lobe alone, however much specular light lies over it
(the two colors of Nayar, Fang and Boult 1997, "Separation of reflection components using color and
polarization", with the diffuse light's own polarization). In a channel c of a pixel,

    (S1, S2)_c = (rho_s specular - rho_d diffuse_c) (cos, sin)(2 (azimuth + pi/2)),

so the slope of (S1, S2) over S0 among the channels is ``rho_d (cos, sin)(2 azimuth)``: the azimuth up to half
a turn, without the quarter turn, and the zenith of the diffuse lobe, without the bias of a mixture.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.optics._numerics import (
    check_leading,
    check_refractive_index,
    for_arrays,
    safe_atan2,
    window_mean,
)
from polarguide.optics.fresnel import diffuse_dolp_limit, diffuse_zenith
from polarguide.optics.stokes import dolp, luminance


class ChromaticNormals(NamedTuple):
    """Normals from color differences, as angles.

    Attributes:
        zenith: [H, W] radians, of the diffuse lobe whose degree of polarization is the slope's.
        azimuth: [H, W] radians in (-pi/2, pi/2], up to half a turn.
        certainty: [H, W] explained over unexplained polarization, a ratio of standard deviations; 0 where
            there is no color.
        decided: [H, W] bool, where diffuse light alone can explain the slope: see ``chromatic_normals``.
        contrast: [H, W] standard deviation of S0 among the colors of the window, as a share of S0; 0 or more.
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
    """Zenith and azimuth from the slope of (S1, S2) over S0 among the colors of a small window.

    A colored reflection has a slope of its own, ``rho_s`` times the opposite direction. The two are told
    apart by the mean polarization: where it points against the slope, both lobes are there, and the one that
    differs between colors is the weaker in polarization, which body color explains; where it points along
    the slope, the pixel may be one colored lobe of either kind, and is decided only if its degree of
    polarization is as small as diffuse light has it at most zeniths.

    Args:
        stokes: [3, H, W, C] with the colors last.
        refractive_index: of the surface, more than 1.
        window: odd side of the window in pixels; the surface should be flat over it.
        minimum_certainty: least certainty of a decided pixel.
        minimum_contrast: least standard deviation of S0 among the colors, as a share of S0.
        pure_lobe_dolp: largest degree of polarization where the mean points along the slope.

    Returns:
        ChromaticNormals. Nothing is decided in a picture without color.

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
    slope1, slope2 = slope1 / variance.clamp(min=least), slope2 / variance.clamp(min=least)
    degree = torch.hypot(slope1, slope2)
    explained = degree * variance.sqrt()
    unexplained = (spread - explained**2).clamp(min=0).sqrt()
    # What rounding leaves of a picture without color explains nothing.
    colored = variance.sqrt() > minimum_contrast * s0
    certainty = torch.where(colored, explained / unexplained.clamp(min=1e-6 * s0.abs() + least), 0.0)
    limit = diffuse_dolp_limit(refractive_index)
    against = slope1 * s1 + slope2 * s2 < 0
    decided = colored & (certainty >= minimum_certainty) & (degree < 0.95 * limit)
    decided = decided & (against | (dolp(mean) < pure_lobe_dolp))
    zenith = diffuse_zenith(degree.clamp(max=limit), refractive_index)
    contrast = variance.sqrt() / s0.clamp(min=least)
    return ChromaticNormals(zenith, safe_atan2(slope2, slope1) / 2, certainty, decided, contrast)
