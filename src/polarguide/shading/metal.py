"""Metals beside dielectrics in the deferred shading model.

A Gaussian is a metal or a dielectric (``metalness`` 1 or 0, decided by ``training.metals`` or by masks, never learned);
before the last decision it can be a mixture of both.
A metal has no diffuse reflection: its base color and its strength do not count. What it reflects is

    specular = R(r, i) L

with R of a conductor (``optics.conductor``) of reflectance r at normal incidence per color, and L the light that a
dielectric would mirror there, too. Blended are ``metalness``, and reflectance times ``metalness``; a pixel that metals
share with others adds both.

``convert`` makes Gaussians metals, or dielectrics again. What a dielectric's base color showed from a direction, a
metal mirrors from the direction that belongs to it at the Gaussian's normal. Mirroring maps harmonics of a degree onto
themselves, so that the base color over the reflectance becomes light of the Gaussian's own exactly; less the
environment's, as far as harmonics can tell it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from polarguide import optics
from polarguide.gaussians.gaussians import Gaussians, any_nonzero
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.harmonics import sh_basis
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, spread_directions, unit
from polarguide.optics.fresnel import LARGEST_REFLECTANCE
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.result import Layout, MetalPixels

# Of which a metal's reflectance is trained between these.
LEAST = 0.2
FIRST_REFLECTANCE = 0.7
# Pixels with less of a metal than this are shaded as dielectrics alone.
MINIMUM_SHARE = 0.01


def reflectance(logits: Tensor) -> Tensor:
    """Reflectance at normal incidence of its parameter, within what metals have."""
    return LEAST + (LARGEST_REFLECTANCE - LEAST) * torch.sigmoid(logits)


def reflectance_logits(values: Tensor) -> Tensor:
    """The inverse of ``reflectance``; values beyond its range, and the ends themselves, come a little inside."""
    return torch.logit(((values - LEAST) / (LARGEST_REFLECTANCE - LEAST)).clamp(0.02, 0.98))


def metal_channels(metalness: Tensor, reflectances: Tensor) -> Tensor:
    """Blended channels of metals, [N, 4]: reflectance times metalness, and metalness."""
    m = metalness[:, None]
    return torch.cat((m * reflectances, m), dim=1)


def where_metal(features: Tensor, first: int) -> Tensor:
    """Pixels [K] that show metal, ascending, of ``metal_pixels``' features."""
    return (features[:, first + 3].detach() > MINIMUM_SHARE).nonzero()[:, 0]


def metal_pixels(
    features: Tensor, layout: Layout, rays: Tensor, normal: Tensor, light: Tensor
) -> MetalPixels:
    """Shade what shows metal: the reference implementation of what ``reflect_native`` does of metals.

    Args:
        features: [P, C] blended. layout: layout of its channels: ``metal`` as of ``metal_channels``.
        rays: [P, 3] unit, world. normal: [P, 3] blended, world.
        light: [P, 3] that is mirrored.
    """
    pixels = where_metal(features, layout.first("metal"))
    # All channels at once: each part taken by itself would send back a picture of all of them.
    metal = features[pixels]
    rays = rays[pixels]
    facing = unit(normal[pixels], 1e-3)
    metal = metal[:, layout.channels("metal")]
    share = metal[:, 3]
    inverse = 1 / share.clamp(min=MINIMUM_SHARE)
    mean, slope = optics.conductor(-dot(rays, facing)[:, None], metal[:, :3] * inverse[:, None])
    return MetalPixels(pixels, share.detach(), share[:, None] * mean * light[pixels], slope)


def with_metal(layers: Mapping[str, Any], metal: MetalPixels) -> dict[str, Any]:
    """Layers of a picture [H, W, 3] and what metals add to them."""
    return {**layers, **{name: add_metal(layers[name], metal) for name in ("final", "specular")}}


def add_metal(layer: Tensor, metal: MetalPixels) -> Tensor:
    """A picture [H, W, 3] and what metals reflect in it."""
    return layer.flatten(0, 1).index_add(0, metal.pixels, metal.specular).view_as(layer)


def metalness_picture(metal: MetalPixels | None, like: Tensor) -> Tensor:
    """Blended metalness [H, W] of a picture with as many pixels as ``like`` [H, W, ...] has."""
    empty = like.new_zeros(like.shape[0] * like.shape[1])
    if metal is not None:
        empty = empty.index_copy(0, metal.pixels, metal.share.detach())
    return empty.view(like.shape[:2])


def metal_stokes(
    specular: Tensor,
    diffuse: Tensor,
    normal: Tensor,
    metal: MetalPixels,
    camera: Camera,
    refractive_index: float | Tensor,
) -> Tensor:
    """Stokes vectors [3, K, 3] of the pixels that show metal, from layers on the scale of S0/2.

    What metals reflect has their degree of polarization, the rest that of a dielectric's lobes.

    Args:
        specular, diffuse, normal: [H, W, 3]. metal: with what it adds to ``specular``.
        refractive_index: refractive index of the rest, a number or [K].
    """
    at = metal.pixels
    rays = camera.rays(device=normal.device).flatten(0, 1)[at]
    facing = unit(camera.to_camera(normal).flatten(0, 1)[at])
    over = specular.flatten(0, 1)[at]
    under = diffuse.flatten(0, 1)[at]
    stokes = optics.predicted_stokes(2 * (over - metal.specular), 2 * under, facing, rays, refractive_index)
    x_ref, up_ref = optics.lens_frame(rays)
    x = dot(facing, x_ref)[:, None]
    y = dot(facing, up_ref)[:, None]
    polarized = 2 * metal.slope * metal.specular
    added = torch.stack((2 * metal.specular, -polarized * (x * x - y * y), -polarized * (2 * x * y)))
    return stokes + added


MOST_STRENGTH = 0.98
# Directions in which functions are compared, and Gaussians at a time.
DIRECTIONS = 128
CHUNK = 4096


def become_metal(
    gaussians: Gaussians,
    texels: Tensor,
    radiance: Callable[[Tensor], Tensor],
    metalness: Tensor,
    reflectances: Tensor,
    gain: Callable[[], float],
) -> None:
    """Change which Gaussians are metals.

    Args:
        texels: [6, R, R, 3] raw light from afar, changed in place. radiance: radiance of raw values.
        metalness: [N], 0 to 1. reflectances: [N, 3] at normal incidence, first values of new metals.
        gain: factor by which all light should be brighter, called when the first metals appear.
    """
    first = not any_nonzero(gaussians, "metalness")
    fresh = convert(gaussians, metalness, reflectances)
    if not any_nonzero(gaussians, "metalness"):
        return
    if first:
        scale_light(gaussians, texels, gain())
    if gaussians.get("local_dc") is not None:
        mirror_base(gaussians, texels, fresh, radiance)


@torch.no_grad()
def convert(gaussians: Gaussians, metalness: Tensor, reflectances: Tensor) -> Tensor:
    """Set the metalness of Gaussians. What begins or ends to be a metal has no light of its own at first; what is a
    dielectric again has the base color and the strength that it had before. Nothing else is changed.

    Args:
        metalness: [N], 0 to 1. reflectances: [N, 3] at normal incidence, of new ones.

    Returns:
        [N] bool, the new ones.
    """
    changed = (metalness > 0) != (gaussians["metalness"] > 0)
    fresh = (metalness > 0) & changed
    gaussians.overwrite("metalness", metalness)
    gaussians.overwrite("reflectance_logits", reflectance_logits(reflectances), fresh)
    for name, own in _local(gaussians):
        gaussians.overwrite(name, torch.zeros_like(own), changed)
    return fresh


def _local(gaussians: Gaussians) -> list[tuple[str, Tensor]]:
    """Names and values of the light of their own, if they have some."""
    tensors = ((name, gaussians.get(name)) for name in ("local_dc", "local_rest"))
    return [(name, own) for name, own in tensors if own is not None]


@torch.no_grad()
def scale_light(gaussians: Gaussians, texels: Tensor, gain: float) -> None:
    """Make all light brighter, and strengths as much smaller, with Adam's moments of both at zero; 1 changes nothing.

    Args:
        texels: logarithms, changed in place.
    """
    if gain == 1:
        return
    texels.add_(math.log(gain))
    strength = (torch.sigmoid(gaussians["strength_logits"]) / gain).clamp(max=MOST_STRENGTH)
    gaussians.overwrite("strength_logits", torch.logit(strength))
    for name, own in _local(gaussians):
        gaussians.overwrite(name, gain * own)


@torch.no_grad()
def mirror_base(
    gaussians: Gaussians, texels: Tensor, fresh: Tensor, radiance: Callable[[Tensor], Tensor]
) -> None:
    """Give new metals the light of their own that makes them look as before; see the module's text.

    Args:
        texels: [6, R, R, 3] raw. fresh: [N] bool. radiance: of raw values.
    """
    means = gaussians["means"]
    toward = spread_directions(DIRECTIONS).to(means)
    basis = sh_basis(toward, 3)
    solve = torch.linalg.pinv(basis)
    far = radiance(cubemap_lookup(texels.detach(), toward))
    axes = shortest_axis_normals(
        means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
    )
    originals = [gaussians[name].clone() for name in ("local_dc", "local_rest")]
    for chosen in fresh.nonzero()[:, 0].split(CHUNK):
        normals = axes[chosen]
        seen_along = toward - 2 * (normals @ toward.T)[..., None] * normals[:, None]
        coefficients = torch.cat((gaussians["sh_dc"][chosen][:, None], gaussians["sh_rest"][chosen]), dim=1)
        base = sh_basis(seen_along, 3) @ coefficients + 0.5
        target = base / reflectance(gaussians["reflectance_logits"][chosen])[:, None] - far
        local = solve @ target
        originals[0][chosen], originals[1][chosen] = local[:, 0], local[:, 1:]
    for name, values in zip(("local_dc", "local_rest"), originals, strict=True):
        gaussians.overwrite(name, values, fresh)
