"""Gaussians that become metals, or dielectrics again: what was learned of them goes on as far as it still has meaning.

What a dielectric's base color showed from a direction, a metal mirrors from the direction that belongs to it at the
Gaussian's normal. Mirroring maps harmonics of a degree onto themselves, so that the base color over the reflectance
becomes light of the Gaussian's own exactly; less the environment's, as far as harmonics can tell it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.harmonics import sh_basis
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.metal import FIRST_ROUGHNESS, reflectance, reflectance_logits
from polarguide.vectors import spread_directions

MOST_STRENGTH = 0.98
# Directions in which functions are compared, and Gaussians at a time.
DIRECTIONS, CHUNK = 128, 4096


@torch.no_grad()
def convert(gaussians: Gaussians, metal: Tensor, reflectances: Tensor) -> Tensor:
    """Set which Gaussians are metals. Those that change have no light of their own at first; what is a dielectric again
    has the base color and the strength that it had before. Nothing is changed of the others.

    Args:
        metal: [N] bool. reflectances: [N, 3] at normal incidence, of new ones.

    Returns:
        [N] bool, the new ones.
    """
    changed = metal != (gaussians["metalness"] > 0)
    fresh = metal & changed
    if bool(changed.any()):
        gaussians.overwrite("metalness", metal.float())
        gaussians.overwrite("reflectance_logits", reflectance_logits(reflectances), fresh)
        rough = torch.logit(torch.full_like(gaussians["roughness_logits"], FIRST_ROUGHNESS))
        gaussians.overwrite("roughness_logits", rough, fresh)
        for name, own in _local(gaussians):
            gaussians.overwrite(name, torch.zeros_like(own), changed)
    return fresh


def _local(gaussians: Gaussians) -> list[tuple[str, Tensor]]:
    """Names and values of the light of their own, if they have some."""
    found = ((name, gaussians.get(name)) for name in ("local_dc", "local_rest"))
    return [(name, own) for name, own in found if own is not None]


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
    found = [gaussians[name].clone() for name in ("local_dc", "local_rest")]
    for chosen in fresh.nonzero()[:, 0].split(CHUNK):
        normals = axes[chosen]
        seen_along = toward - 2 * (normals @ toward.T)[..., None] * normals[:, None]
        coefficients = torch.cat((gaussians["sh_dc"][chosen][:, None], gaussians["sh_rest"][chosen]), dim=1)
        base = sh_basis(seen_along, 3) @ coefficients + 0.5
        target = base / reflectance(gaussians["reflectance_logits"][chosen])[:, None] - far
        local = solve @ target
        found[0][chosen], found[1][chosen] = local[:, 0], local[:, 1:]
    for name, values in zip(("local_dc", "local_rest"), found, strict=True):
        gaussians.overwrite(name, values, fresh)
