"""Evidence for each Gaussian and its neighborhood: how well a dielectric and a metal explain all views.

At a Gaussian, a view measures S0 and, per color, the polarization P across the rendered normal's plane of incidence.

- A dielectric's body light d is the same from everywhere, and its specular light s is free:
  ``S0 = d + s``, ``P = rho_s s - rho_d d``. Without s, ``(rho_s + rho_d) d = rho_s S0 - P`` in every view.
- A metal mirrors light that is free, but polarizes it as its reflectance r says: ``P = rho(r) S0`` in every view.

Either has one unknown per color, which all views share, and one per color and view. Compared are their residuals E
across the line of what the free light can explain, as log(E_dielectric / E_metal) over a neighborhood. That a metal
fits better counts only where no dielectric fits: a matte white body under an even sky could as well be aluminum. And a
metal's color is that of the light it mirrors times r, so that r follows the color that it shows.

In polarized light neither fits. A metal then shows light that is polarized at 45 degrees to the plane of incidence, of
which a dielectric reflects a twentieth at most, up to 60 degrees: where there is much of it, measured by the light of
the scene, and the metal is not much farther off across the plane than at 45 degrees to it, is metal, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.geometry.vectors import dot
from polarguide.raster import Rasterize
from polarguide.shading.metal import FIRST_REFLECTANCE
from polarguide.shading.model import Parameters
from polarguide.training.metals.observations import ViewSamples, evenly, label_weights, samples_of, view_sums
from polarguide.training.rules import MetalRules


def _relative(samples: ViewSamples, dark: float) -> tuple[Tensor, Tensor]:
    """Weights [V, N, 3] of squares, and what their sums over the views are relative to [N, 3]."""
    above = samples.s0.clamp(min=0) + dark  # the variance of light that is counted grows with the light
    weight = samples.weight[..., None] / above
    return weight, (weight * above * above).sum(dim=0).clamp(min=1e-9)


def residuals(
    samples: ViewSamples, refractive_index: float, rules: MetalRules
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean squares of the relative residuals of a dielectric and of a metal [N], and the metal's reflectance [N, 3]."""
    s0, across, cosine = samples.s0, samples.across, samples.cosine[..., None]
    sine2 = 1 - cosine * cosine
    weight, scale = _relative(samples, rules.dark)
    specular, diffuse = (slope * sine2 for slope in optics.dolp_slopes(cosine, refractive_index))
    seen_body, of_body = specular * s0 - across, specular + diffuse
    by_line = weight / (1 + specular * specular)
    body = (by_line * of_body * seen_body).sum(dim=0) / (by_line * of_body**2).sum(dim=0).clamp(min=1e-9)
    misfit = (by_line * (seen_body - of_body * body.clamp(min=0)) ** 2).sum(dim=0) / scale
    color = (samples.weight[..., None] * s0).sum(dim=0)
    color = (color / color.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(min=0.05)
    best = torch.full_like(misfit[:, 0], torch.inf)
    fitted = torch.zeros_like(color)
    for power in rules.powers:
        for level in rules.levels:
            reflectance = level * color**power
            degree = optics.conductor(cosine, reflectance)[1] * sine2
            off = (weight * (across - degree * s0) ** 2 / (1 + degree * degree)).sum(dim=0) / scale
            error = off.mean(dim=1)
            better = error < best
            best = torch.where(better, error, best)
            fitted = torch.where(better[:, None], reflectance, fitted)
    return misfit.mean(dim=1), best, fitted


def oblique_light(samples: ViewSamples, dark: float) -> Tensor:
    """Mean squares [N] of the polarization at 45 degrees to the plane of incidence, relative like the residuals."""
    weight, scale = _relative(samples, dark)
    return ((weight * samples.oblique**2).sum(dim=0) / scale).mean(dim=1)


CHUNK = 1 << 14
"""Gaussians at a time, so that intermediate tensors take little memory."""


class Evidence(NamedTuple):
    """Evidence of the views for N Gaussians.

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
        labels: [N, 2] weight of pixels that the user calls dielectric and metal.
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
    labels: Tensor


class _Explanations(NamedTuple):
    """How each of N Gaussians is explained by itself: mean squares of residuals as a dielectric and as a metal, that
    metal's reflectance [N, 3], the mean square at 45 degrees, how much is known of it, and its color [N, 3].
    """

    dielectric: Tensor
    metal: Tensor
    reflectance: Tensor
    oblique: Tensor
    known: Tensor
    color: Tensor


@torch.no_grad()
def evidence(
    gaussians: Parameters,
    views: Sequence[View],
    rasterize: Rasterize,
    refractive_index: float,
    rules: MetalRules,
    memory: MemoryBound = UNBOUNDED,
) -> Evidence:
    """Evidence of the views for each Gaussian; see ``training.metals.evidence``.

    Views whose pictures do not determine the Stokes vector say what the user says of materials in them, no more.
    """
    labels = label_weights(gaussians, views, rasterize, memory)
    explained = None
    if measured := evenly([view for view in views if view.is_determined], rules.most_views):
        looks = view_sums(gaussians, memory.between(measured), rasterize, rules)
        explained = _explained(looks, refractive_index, rules)
        del looks
    memory.clear()
    near, alike = _neighborhoods(gaussians, rules.neighbors)
    if explained is None:
        return _nothing_measured(near, alike, labels)
    return _of_neighbors(explained, near, alike, labels, rules)


def _chunks(count: int) -> list[slice]:
    """Some Gaussians at a time, so that what is computed of all of them takes little memory."""
    return [slice(begin, min(begin + CHUNK, count)) for begin in range(0, max(1, count), CHUNK)]


def _neighborhoods(gaussians: Parameters, most: int) -> tuple[Tensor, Tensor]:
    """The nearest of each Gaussian [N, K], and how alike they are turned."""
    means = gaussians["means"].detach()
    places = means.cpu().double().numpy()
    count = min(most, len(places))
    tree, axes = (
        cKDTree(places),
        shortest_axis_normals(
            means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
        ),
    )
    near = torch.empty(len(places), count, dtype=torch.int64, device=means.device)
    alike = means.new_empty(len(places), count)
    for chunk in _chunks(len(places)):
        neighbors = torch.from_numpy(tree.query(places[chunk], k=count)[1])
        near[chunk] = neighbors.view(-1, count).to(means.device)
        alike[chunk] = dot(axes[chunk, None], axes[near[chunk]]) ** 4
    return near, alike


def _nothing_measured(near: Tensor, alike: Tensor, labels: Tensor) -> Evidence:
    """Evidence of the user's words alone."""
    none = labels.new_zeros(len(labels))
    gray = labels.new_full((len(labels), 3), FIRST_REFLECTANCE)
    return Evidence(none, none, gray, near, alike, none, none, none, none, none, labels)


def _explained(looks: Sequence[Tensor], refractive_index: float, rules: MetalRules) -> _Explanations:
    """Explanations of all Gaussians, of which ``looks`` are ``view_sums``."""
    parts = []
    for chunk in _chunks(len(looks[0])):
        samples = samples_of(looks, chunk, rules)
        total = samples.weight.sum(dim=0)
        effective = total * total / (samples.weight**2).sum(dim=0).clamp(min=1e-9)
        color = (samples.weight[..., None] * samples.s0).sum(dim=0) / total.clamp(min=1e-6)[:, None]
        certainty = total.clamp(max=20) * (effective > rules.least_views)
        fitted = residuals(samples, refractive_index, rules)
        parts.append(
            _Explanations(*fitted, oblique_light(samples, rules.dark), certainty, color.clamp(min=0))
        )
    return _Explanations(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _of_neighbors(
    explained: _Explanations, near: Tensor, alike: Tensor, labels: Tensor, rules: MetalRules
) -> Evidence:
    """Evidence of what was measured, over neighborhoods in which those of like color count."""
    certainty = explained.known
    mean = (explained.color * certainty[:, None]).sum(dim=0) / certainty.sum().clamp(min=1e-6)
    tints = explained.color / mean.clamp(min=1e-6)
    color = explained.color + rules.dark
    brightness = color.mean(dim=1)
    floor = rules.least_residual
    ratio = (explained.dielectric.clamp(min=floor) / explained.metal.clamp(min=floor)).log()
    each = (
        ratio,
        explained.dielectric,
        explained.metal,
        explained.oblique,
        *explained.reflectance.unbind(1),
        *tints.unbind(1),
    )
    means, support = [], []
    for chunk in _chunks(len(near)):
        nearest = near[chunk]
        like_color = _like_color(color, chunk, nearest, rules)
        trust = (certainty + 1e-6)[nearest] * like_color
        whole = trust.sum(dim=1)
        means.append(torch.stack([(values[nearest] * trust).sum(dim=1) / whole for values in each]))
        support.append((certainty > rules.least_weight).float()[nearest].mean(dim=1))
        alike[chunk] *= like_color
    ratio, dielectric, metal, oblique, *rest = torch.cat(means, dim=1)
    tints = torch.stack(rest[3:], dim=1)
    return Evidence(
        ratio=ratio,
        misfit=dielectric.sqrt(),
        reflectance=torch.stack(rest[:3], dim=1),
        near=near,
        alike=alike,
        brightness=brightness * certainty.sum() / (brightness * certainty).sum().clamp(min=1e-6),
        tint=tints.amin(dim=1) / tints.amax(dim=1).clamp(min=1e-6),
        metal_misfit=metal.sqrt(),
        oblique=oblique.sqrt(),
        support=torch.cat(support),
        labels=labels,
    )


def _like_color(color: Tensor, which: slice, near: Tensor, rules: MetalRules) -> Tensor:
    """How much the neighbors [n, K] of some Gaussians look like them, in [0, 1]; of colors [N, 3] over 0."""
    brightness, logarithms = color.mean(dim=1).log(), color.log()
    tint = logarithms - logarithms.mean(dim=1, keepdim=True)
    brighter = (brightness[near] - brightness[which, None]) / rules.like_brightness
    tinted = (tint[near] - tint[which, None]) / rules.like_tint
    return torch.exp(-0.5 * (brighter.square() + tinted.square().mean(dim=2)))
