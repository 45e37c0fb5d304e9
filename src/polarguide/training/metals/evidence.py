"""What the views say of each Gaussian and its neighborhood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.capture import View
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster import Rasterize
from polarguide.shading.metal import FIRST_REFLECTANCE
from polarguide.shading.model import Parameters
from polarguide.training.metals.explanations import DARK, oblique_light, residuals
from polarguide.training.metals.looks import Seen, seen_by
from polarguide.training.metals.words import LEAST_SEEN, said_by
from polarguide.vectors import dot

LEAST_VIEWS = 4.0
NEIGHBORS = 64
# Mean squares of relative residuals below this count as this.
LEAST_RESIDUAL = 2e-4
# Neighbors whose brightness, or whose colors in proportion to it, differ by this factor's logarithm are of another
# material, more or less.
LIKE_BRIGHTNESS, LIKE_TINT = 0.4, 0.25


class Evidence(NamedTuple):
    """What the views say of N Gaussians.

    Attributes:
        ratio: [N] log(E_dielectric / E_metal), over the neighborhood, in which those of like brightness count.
        misfit: [N] root of the mean E_dielectric of the neighborhood: how far from any dielectric.
        reflectance: [N, 3] of the metal that fits best.
        near: [N, K] int64 the neighborhoods, nearest first.
        alike: [N, K] in [0, 1], how alike neighbors are turned, and how alike their color is: others belong to
            another surface, such as the table under a pot, or are of another material, such as the tire around a wheel.
        brightness: [N] mean S0 of what is seen, over that of all that is seen.
        tint: [N] in [0, 1], what is seen in the weakest over that in the strongest color, each over the scene's mean,
            of the neighborhood: of a metal no less than its reflectances are apart.
        metal_misfit: [N] root of the mean E_metal of the neighborhood.
        oblique: [N] root of the mean square of what is polarized at 45 degrees to the plane of incidence, of the
            neighborhood, relative like the residuals.
        support: [N] share of the neighborhood that enough views show.
        said: [N, 2] weight of pixels that the user calls dielectric and metal.
    """

    ratio: Tensor
    misfit: Tensor
    reflectance: Tensor
    near: Tensor
    alike: Tensor
    brightness: Tensor
    tint: Tensor
    metal_misfit: Tensor
    oblique: Tensor
    support: Tensor
    said: Tensor


@torch.no_grad()
def evidence(
    gaussians: Parameters, views: Sequence[View], rasterize: Rasterize, refractive_index: float
) -> Evidence:
    """What views say of each Gaussian; see ``training.metals.explanations``.

    Views whose pictures do not determine the Stokes vector say what the user says of materials in them, no more.
    """
    near, alike = _neighborhoods(gaussians)
    said = said_by(gaussians, views, rasterize)
    measured = [view for view in views if view.is_determined]
    if not measured:
        return _nothing_measured(near, alike, said)
    return _of_neighbors(seen_by(gaussians, measured, rasterize), near, alike, said, refractive_index)


def _neighborhoods(gaussians: Parameters) -> tuple[Tensor, Tensor]:
    """The nearest of each Gaussian [N, K], and how alike they are turned."""
    means = gaussians["means"].detach()
    places = means.cpu().double().numpy()
    count = min(NEIGHBORS, len(places))
    found = cKDTree(places).query(places, k=count)[1]
    near = torch.from_numpy(found).view(len(places), count).to(means.device)
    axes = shortest_axis_normals(
        means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
    )
    return near, dot(axes[:, None], axes[near]) ** 4


def _nothing_measured(near: Tensor, alike: Tensor, said: Tensor) -> Evidence:
    """Evidence of the user's words alone."""
    none = said.new_zeros(len(said))
    gray = said.new_full((len(said), 3), FIRST_REFLECTANCE)
    return Evidence(none, none, gray, near, alike, none, none, none, none, none, said)


def _of_neighbors(seen: Seen, near: Tensor, alike: Tensor, said: Tensor, refractive_index: float) -> Evidence:
    """Evidence of what was measured, over neighborhoods in which those of like color count."""
    dielectric, metal, reflectance = residuals(seen, refractive_index)
    total = seen.weight.sum(dim=0)
    effective = total * total / (seen.weight**2).sum(dim=0).clamp(min=1e-9)
    known = total.clamp(max=20) * (effective > LEAST_VIEWS)
    color = ((seen.weight[..., None] * seen.s0).sum(dim=0) / total.clamp(min=1e-6)[:, None]).clamp(min=0)
    mean = (color * known[:, None]).sum(dim=0) / known.sum().clamp(min=1e-6)
    tints = color / mean.clamp(min=1e-6)
    color = color + DARK
    brightness = color.mean(dim=1)
    like_color = _like_color(color, near)
    trust = (known + 1e-6)[near] * like_color

    def over_neighbors(values: Tensor) -> Tensor:
        return (values[near] * trust).sum(dim=1) / trust.sum(dim=1)

    ratio = (dielectric.clamp(min=LEAST_RESIDUAL) / metal.clamp(min=LEAST_RESIDUAL)).log()
    tints = torch.stack([over_neighbors(t) for t in tints.unbind(1)], dim=1)
    return Evidence(
        ratio=over_neighbors(ratio),
        misfit=over_neighbors(dielectric).sqrt(),
        reflectance=torch.stack([over_neighbors(r) for r in reflectance.unbind(1)], dim=1),
        near=near,
        alike=alike * like_color,
        brightness=brightness * known.sum() / (brightness * known).sum().clamp(min=1e-6),
        tint=tints.amin(dim=1) / tints.amax(dim=1).clamp(min=1e-6),
        metal_misfit=over_neighbors(metal).sqrt(),
        oblique=over_neighbors(oblique_light(seen)).sqrt(),
        support=(known > LEAST_SEEN).float()[near].mean(dim=1),
        said=said,
    )


def _like_color(color: Tensor, near: Tensor) -> Tensor:
    """How much the neighbors [N, K] of each Gaussian look like it, in [0, 1]; of colors [N, 3] over 0."""
    brightness, logarithms = color.mean(dim=1).log(), color.log()
    tint = logarithms - logarithms.mean(dim=1, keepdim=True)
    brighter = (brightness[near] - brightness[:, None]) / LIKE_BRIGHTNESS
    tinted = (tint[near] - tint[:, None]) / LIKE_TINT
    return torch.exp(-0.5 * (brighter.square() + tinted.square().mean(dim=2)))
