"""Metals in the deferred shading model.

A Gaussian has a ``metalness`` of 1 (metal) or 0 (dielectric). It is not learned, but set by ``training.metals`` or by
labels. Until the last decision, a Gaussian can also be a mixture of both. A metal has no diffuse reflection, so its
base color and strength have no effect. Its reflection is

    specular = R(r, i) L

R is the reflectance of a conductor (``optics.conductor``) for each color, with reflectance r at normal incidence. L is
the same mirrored light as for a dielectric. ``metalness`` and the product of reflectance and ``metalness`` are blended.
In a pixel with metals and dielectrics, the contributions of both are added.

``convert`` turns Gaussians into metals or back into dielectrics. ``mirror_base`` then gives each new metal a local
light with which it looks like the previous base color from each direction. This conversion is exact, because a
reflection at the Gaussian's normal maps harmonics of a degree to harmonics of the same degree. The light of the
environment is subtracted, up to the degree of the harmonics.
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
from polarguide.shading.result import MetalPixels, RenderResult

LEAST = 0.2
"""Lower bound of a metal's reflectance."""
FIRST_REFLECTANCE = 0.7
"""Reflectance of metals before the first step."""
MINIMUM_SHARE = 0.01
"""Metalness of a pixel below which it is shaded as a dielectric."""


def reflectance(logits: Tensor) -> Tensor:
    """Convert the learned parameter to the reflectance at normal incidence, within the range of metals."""
    return LEAST + (LARGEST_REFLECTANCE - LEAST) * torch.sigmoid(logits)


def reflectance_logits(values: Tensor) -> Tensor:
    """Convert reflectances to the learned parameter, after clamping them to the interior of the range of metals."""
    return torch.logit(((values - LEAST) / (LARGEST_REFLECTANCE - LEAST)).clamp(0.02, 0.98))


def where_metal(features: Tensor, first: int) -> Tensor:
    """Return the indices [K] of pixels that show metal, ascending.

    Args:
        features: [P, C] blended features.
        first: index of the first of four channels, which are reflectance times metalness (3) and metalness (1).
    """
    return (features[:, first + 3].detach() > MINIMUM_SHARE).nonzero()[:, 0]


def metal_pixels(features: Tensor, first: int, rays: Tensor, normal: Tensor, light: Tensor) -> MetalPixels:
    """Shade the pixels that show metal.

    This is the reference implementation of metals in ``reflect_native``.

    Args:
        features: [P, C] blended features.
        first: index of the first channel of metals, see ``where_metal``.
        rays: [P, 3] unit rays, world axes.
        normal: [P, 3] blended normals, world axes.
        light: [P, 3] mirrored light.
    """
    pixels = where_metal(features, first)
    # Gather all channels at once: the gradient of each gather is a whole picture.
    metal = features[pixels]
    rays = rays[pixels]
    facing = unit(normal[pixels], 1e-3)
    metal = metal[:, first : first + 4]
    share = metal[:, 3]
    inverse = 1 / share.clamp(min=MINIMUM_SHARE)
    mean, slope = optics.conductor(-dot(rays, facing)[:, None], metal[:, :3] * inverse[:, None])
    return MetalPixels(pixels, share.detach(), share[:, None] * mean * light[pixels], slope)


def with_metal(layers: Mapping[str, Any], metal: MetalPixels) -> dict[str, Any]:
    """Add the contribution of metals to the layers [H, W, 3] of a picture."""
    sums = {
        name: layers[name].flatten(0, 1).index_add(0, metal.pixels, metal.specular).view_as(layers[name])
        for name in ("final", "specular")
    }
    return {**layers, **sums}


def metalness_picture(metal: MetalPixels | None, like: Tensor) -> Tensor:
    """Return the blended metalness [H, W] of a picture, in the size of ``like`` [H, W, ...]."""
    empty = like.new_zeros(like.shape[0] * like.shape[1])
    if metal is not None:
        empty = empty.index_copy(0, metal.pixels, metal.share.detach())
    return empty.view(like.shape[:2])


def layer_stokes(result: RenderResult, camera: Camera, refractive_index: float) -> Tensor:
    """Predict Stokes vectors [3, H, W, 3] of a picture of smooth dielectrics and metals.

    Light from metals has the degree of polarization of metals. All other light has the degree of polarization of the
    specular or diffuse lobe of a dielectric.

    Args:
        result: picture with the specular and diffuse layers and the normal.
        camera: camera of the picture.
        refractive_index: refractive index of the run, for pictures without the layer ``index``.
    """
    normal = result.shaded_normal
    facing = camera.to_camera(normal)
    rays = camera.rays(device=normal.device)
    index = result.layers.get("index", refractive_index)
    specular = result.layers["specular"]
    diffuse = result.layers["diffuse"]
    stokes = optics.predicted_stokes(2 * specular, 2 * diffuse, facing, rays, index)
    if result.metal is None:
        return stokes
    at = result.metal.pixels
    facing = unit(facing.flatten(0, 1)[at])
    rays = rays.flatten(0, 1)[at]
    others = specular.flatten(0, 1)[at] - result.metal.specular
    under = diffuse.flatten(0, 1)[at]
    index = index.flatten()[at] if isinstance(index, Tensor) else index
    metal = optics.predicted_stokes(2 * others, 2 * under, facing, rays, index)
    x_ref, up_ref = optics.lens_frame(rays)
    x = dot(facing, x_ref)[:, None]
    y = dot(facing, up_ref)[:, None]
    polarized = 2 * result.metal.slope * result.metal.specular
    added = torch.stack((2 * result.metal.specular, -polarized * (x * x - y * y), -polarized * (2 * x * y)))
    return stokes.flatten(1, 2).index_copy(1, at, metal + added).view_as(stokes)


MOST_STRENGTH = 0.98
"""Upper bound of strengths after the light has been made brighter."""
DIRECTIONS = 128
"""Number of directions in which base color and mirrored light are compared."""
CHUNK = 4096
"""Number of Gaussians per batch of that comparison."""


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
        gaussians: the Gaussians, changed in place.
        texels: [6, R, R, 3] raw texels of the environment, changed in place.
        radiance: function from raw values to radiance.
        metalness: [N] new metalness, 0 to 1.
        reflectances: [N, 3] reflectances at normal incidence, with which new metals start.
        gain: function that returns a factor on all light. It is called when the first metals appear.
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
    """Set the metalness of Gaussians.

    Converted Gaussians start without local light. Base color and strength do not change, so that a metal can become the
    same dielectric again.

    Args:
        gaussians: the Gaussians, changed in place.
        metalness: [N] new metalness, 0 to 1.
        reflectances: [N, 3] reflectances of new metals at normal incidence.

    Returns:
        Mask [N], True for new metals.
    """
    changed = (metalness > 0) != (gaussians["metalness"] > 0)
    fresh = (metalness > 0) & changed
    gaussians.overwrite("metalness", metalness)
    gaussians.overwrite("reflectance_logits", reflectance_logits(reflectances), fresh)
    for name, own in _local_light(gaussians):
        gaussians.overwrite(name, torch.zeros_like(own), changed)
    return fresh


def _local_light(gaussians: Gaussians) -> list[tuple[str, Tensor]]:
    """Return names and values of the harmonics of local light, if the Gaussians have such light."""
    tensors = ((name, gaussians.get(name)) for name in ("local_dc", "local_rest"))
    return [(name, own) for name, own in tensors if own is not None]


@torch.no_grad()
def scale_light(gaussians: Gaussians, texels: Tensor, gain: float) -> None:
    """Multiply all light by ``gain`` and divide the strengths by it; Adam's moments of the Gaussians become zero.

    Args:
        gaussians: the Gaussians, changed in place.
        texels: logarithms of radiance, changed in place.
        gain: the factor; 1 changes nothing.
    """
    if gain == 1:
        return
    texels.add_(math.log(gain))
    strength = (torch.sigmoid(gaussians["strength_logits"]) / gain).clamp(max=MOST_STRENGTH)
    gaussians.overwrite("strength_logits", torch.logit(strength))
    for name, own in _local_light(gaussians):
        gaussians.overwrite(name, gain * own)


@torch.no_grad()
def mirror_base(
    gaussians: Gaussians, texels: Tensor, fresh: Tensor, radiance: Callable[[Tensor], Tensor]
) -> None:
    """Give new metals a local light that does not change their look; see the module.

    Args:
        gaussians: the Gaussians, changed in place.
        texels: [6, R, R, 3] raw texels of the environment.
        fresh: [N] bool, True for new metals.
        radiance: function from raw values to radiance.
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
        directions = toward - 2 * (normals @ toward.T)[..., None] * normals[:, None]
        coefficients = torch.cat((gaussians["sh_dc"][chosen][:, None], gaussians["sh_rest"][chosen]), dim=1)
        base = sh_basis(directions, 3) @ coefficients + 0.5
        target = base / reflectance(gaussians["reflectance_logits"][chosen])[:, None] - far
        local = solve @ target
        originals[0][chosen], originals[1][chosen] = local[:, 0], local[:, 1:]
    for name, values in zip(("local_dc", "local_rest"), originals, strict=True):
        gaussians.overwrite(name, values, fresh)
