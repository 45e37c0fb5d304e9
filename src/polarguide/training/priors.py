"""Polarization priors of a view, from its Stokes vectors and the normals of frozen Gaussians.

This is the coupling of the paper: the Gaussians' normals resolve the ambiguity of the polarization normals and the
separation, and what comes out supervises the Gaussians until the next refresh.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.shading.display import srgb_encode
from polarguide.training.stages import Priors
from polarguide.vectors import dot, unit

# Rendered normals shorter than this are too mixed to say anything.
MINIMUM_NORMAL = 0.3


@dataclass(frozen=True, eq=False)
class ViewPriors:
    """Targets of one view.

    Attributes:
        specular, diffuse: [H, W, 3] shown (sRGB) separated pictures, on the scale of S0/2.
        separated: [H, W] weight of both: 1 where the separation is well conditioned.
        normal: [H, W, 3] disambiguated polarization normal, world axes.
        plane: [H, W, 3] world normal of the plane of incidence that the AoLP names.
        weight: [H, W] weight of ``normal`` and ``plane``, in [0, 1].
    """

    specular: Tensor
    diffuse: Tensor
    separated: Tensor
    normal: Tensor
    plane: Tensor
    weight: Tensor


def guide_normals(normal: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals facing the camera from blended ones [H, W, 3], and where they are trustworthy [H, W].

    A blended normal that faces away (by up to a pixel's slant) is brought to grazing.
    """
    known = dot(normal, normal) > MINIMUM_NORMAL**2
    facing = unit(normal)
    away = dot(facing, rays)[..., None].clamp(min=0)
    return unit(facing - away * 1.001 * rays), known


@torch.no_grad()
def view_priors(view: View, normal: Tensor, settings: Priors, index: float) -> ViewPriors:
    """Compute the priors of one view.

    Args:
        view: the capture.
        normal: [H, W, 3] normals rendered from the frozen Gaussians, world axes, any length.
        settings: which candidates and which separation.
        index: refractive index.
    """
    rays = view.camera.rays()
    stokes = optics.stokes(view.intensities())
    luminance = optics.luminance(stokes)
    guide, known = guide_normals(view.camera.to_camera(normal), rays)
    usable = optics.polarization_mask(
        luminance, threshold=settings.threshold, invalid=view.invalid, saturated=view.saturated
    )
    make = optics.paper_candidates if settings.candidates == "paper" else optics.physical_candidates
    chosen = optics.disambiguate(
        make(luminance, rays, index), guide, rays, azimuth_weight=settings.azimuth_weight
    ).normal
    if settings.separation == "paper":
        zenith = optics.diffuse_zenith(optics.dolp(luminance), index)
        layers = optics.paper_separation(stokes, zenith, index)
        conditioned = ~view.saturated
    else:
        layers = optics.exact_separation(stokes, guide, rays, index)
        conditioned = layers.conditioned & known & ~view.saturated
    plane = unit(torch.linalg.cross(rays, chosen))
    weight = (optics.dolp(luminance) / settings.full_dolp).clamp(max=1) * (usable & known)
    return ViewPriors(
        specular=srgb_encode((layers.specular / 2).clamp(0, 1)),
        diffuse=srgb_encode((layers.diffuse / 2).clamp(0, 1)),
        separated=(conditioned & ~view.invalid).float(),
        normal=view.camera.to_world(chosen),
        plane=view.camera.to_world(plane),
        weight=weight,
    )
