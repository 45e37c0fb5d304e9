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
from polarguide.shading.metal import reflectance, reflectance_logits

MOST_STRENGTH = 0.98
# Directions in which functions are compared, and Gaussians at a time.
DIRECTIONS, CHUNK = 128, 4096


@torch.no_grad()
def convert(gaussians: Gaussians, metal: Tensor, reflectances: Tensor) -> Tensor:
    """Set which Gaussians are metals. Those that are new have no light of their own at first.

    Args:
        metal: [N] bool. reflectances: [N, 3] at normal incidence, of new ones.

    Returns:
        [N] bool, the new ones.
    """
    was = gaussians["metalness"] > 0
    fresh = metal & ~was
    if bool((metal != was).any()):
        gaussians.overwrite("metalness", metal.float())
        logits = torch.where(
            fresh[:, None], reflectance_logits(reflectances), gaussians["reflectance_logits"]
        )
        gaussians.overwrite("reflectance_logits", logits)
        _keep_local(gaussians, ~fresh)
    return fresh


def _keep_local(gaussians: Gaussians, factor: Tensor) -> None:
    for name in ("local_dc", "local_rest"):
        if (own := gaussians.get(name)) is not None:
            gaussians.overwrite(name, own * factor.to(own).view(-1, *[1] * (own.ndim - 1)))


@torch.no_grad()
def scale_light(gaussians: Gaussians, texels: Tensor, gain: float) -> None:
    """Make all light brighter, and strengths as much smaller. texels: logarithms, changed in place."""
    texels.add_(math.log(gain))
    strength = (torch.sigmoid(gaussians["strength_logits"]) / gain).clamp(max=MOST_STRENGTH)
    gaussians.overwrite("strength_logits", torch.logit(strength))
    _keep_local(gaussians, torch.full_like(strength, gain))


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
        gaussians.overwrite(name, values)


def spread_directions(count: int) -> Tensor:
    """Unit vectors [count, 3], evenly over the sphere (a Fibonacci lattice)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * place / count
    around = math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    return torch.stack((flat * around.cos(), flat * around.sin(), z), dim=1).float()
