"""Evidence for each Gaussian: how much likelier what the views measured of it is of a metal than of a dielectric.

At a Gaussian, a view measures S0 and, per color, the polarization P across the rendered normal's plane of incidence and
U at 45 degrees to it. ``rho`` are Fresnel's degrees of polarization.

- A dielectric's body light d is the same from everywhere, and its specular light s is free: ``S0 = d + s``,
  ``P = k rho_s s - rho_d d``; k, from ``ROUGH`` to 1, is what roughness leaves of the polarization.
- A metal mirrors light that is free, but polarizes it as its reflectance r says: ``P = rho(r) S0``. Its color is that
  of the light that it mirrors times r, so that r follows the color that is seen.

Unpolarized light leaves no U. Light that is polarized changes P about as much as U. A metal keeps at most the share
``conductor_oblique_share`` of U (aluminum 0.98 at 45 degrees and 0.91 at 60; copper and gold 0.57 at 60 and 0.1 at 70).
A dielectric makes ``sqrt(Rs Rp)`` times the scene's light at most. Either explanation is therefore excused in P for as
much U as it explains, and has the rest of U as an error.

The errors E, mean squares relative to the light, of n views of unknown variance, at least that of the scene's typical
error e, give the log likelihood ratio ``n log((e^2 + E_dielectric) / (e^2 + E_metal))``: n/2 for each of P and U.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.optics.fresnel import reflectances_from_cosine
from polarguide.raster import Rasterize
from polarguide.shading.metal import FIRST_REFLECTANCE
from polarguide.shading.model import Parameters
from polarguide.training.metals.observations import (
    LEAST_PIXELS,
    ViewSamples,
    evenly,
    label_weights,
    samples_of,
    view_sums,
)
from polarguide.training.recipe import MetalRules, MetalViews

# Shares of its specular polarization that a dielectric's roughness may leave.
ROUGH = (1.0, 0.85, 0.7, 0.55)
# Reflectances that are tried: a level times a power of the observed color.
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.95)
POWERS = (0.5, 0.75, 1.0)
# Weakest over strongest reflectance of the most deeply colored metal, gold.
GOLD = 0.38
# Unknowns of either explanation, for which as many views tell nothing.
UNKNOWNS = 2
# Mean square of the noise of the views, relative to the light: the scene's typical error is no less.
NOISE = 1e-4
# Gaussians at a time, so that intermediate tensors take little memory.
CHUNK = 1 << 14


class Errors(NamedTuple):
    """Errors [N] of both explanations, mean squares relative to the light, and the metal's reflectance [N, 3]."""

    dielectric: Tensor
    metal: Tensor
    reflectance: Tensor


class MetalEvidence(NamedTuple):
    """Evidence of the views for N Gaussians.

    Attributes:
        ratio: [N] log likelihood ratio of metal and dielectric, per view. views: [N] how many independent views it has.
        reflectance: [N, 3] of the metal that fits best.
        color: [N, 3] mean S0.
        labels: [N, 2] weight of pixels that the user calls dielectric and metal.
    """

    ratio: Tensor
    views: Tensor
    reflectance: Tensor
    color: Tensor
    labels: Tensor


def errors(samples: ViewSamples, refractive_index: float, light: float, dark: float) -> Errors:
    """Errors of both explanations of N Gaussians.

    Args:
        light: mean radiance of the scene, S0. dark: radiance added to the one that errors are relative to.
    """
    s0 = samples.s0
    across = samples.across
    cosine = samples.cosine[..., None]
    sine2 = 1 - cosine * cosine
    above = s0.clamp(min=0) + dark  # the variance of light that is counted grows with the light
    weight = samples.weight[..., None] / above
    scale = (weight * above * above).sum(dim=0).clamp(min=1e-9)

    def mean(square: Tensor) -> Tensor:
        return ((weight * square).sum(dim=0) / scale).mean(dim=1)

    specular, diffuse = (slope * sine2 for slope in optics.dolp_slopes(cosine, refractive_index))
    bodies = []
    for left in ROUGH:
        over = left * specular
        by_line = weight / (1 + over * over)
        of_body = over + diffuse
        seen = over * s0 - across
        body = (by_line * of_body * seen).sum(dim=0) / (by_line * of_body**2).sum(dim=0).clamp(min=1e-9)
        bodies.append(mean((seen - of_body * body.clamp(min=0)) ** 2 / (1 + over * over)))
    color = (samples.weight[..., None] * s0).sum(dim=0)
    color = (color / color.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(min=0.05)
    oblique = mean(samples.oblique**2)

    def excused(error: Tensor, largest: Tensor) -> Tensor:
        """The error without what an oblique polarization up to ``largest`` explains, plus what is beyond it."""
        beyond = mean((samples.oblique.abs() - largest).clamp(min=0) ** 2)
        return (error - (oblique - beyond).clamp(min=0)).clamp(min=0) + beyond

    metals = []
    tried = [level * color**power for power in POWERS for level in LEVELS]
    for reflectance in tried:
        n, k = optics.conductor_index(reflectance)
        degree = optics.conductor_dolp_slope(cosine, n, k) * sine2
        error = mean((across - degree * s0) ** 2 / (1 + degree * degree))
        metals.append(excused(error, optics.conductor_oblique_share(cosine, n, k).abs() * s0.clamp(min=0)))
    metal, chosen = torch.stack(metals).min(dim=0)
    s, p = reflectances_from_cosine(cosine, refractive_index)
    dielectric = excused(torch.stack(bodies).amin(dim=0), (s * p).sqrt() * light)
    best = torch.stack(tried)[chosen, torch.arange(len(chosen), device=chosen.device)]
    return Errors(dielectric, metal, best)


@torch.no_grad()
def evidence(
    gaussians: Parameters,
    views: Sequence[View],
    rasterize: Rasterize,
    refractive_index: float,
    rules: MetalRules,
    limits: MetalViews,
    memory: MemoryBound = UNBOUNDED,
) -> MetalEvidence:
    """Evidence of the views for each Gaussian; see ``training.metals.evidence``.

    Views whose pictures do not determine the Stokes vector say what the user says of materials in them, no more.
    """
    labels = label_weights(gaussians, views, rasterize, memory)
    measured = evenly([view for view in views if view.is_determined], limits.most_views)
    if not measured:
        none = labels.new_zeros(len(labels))
        gray = labels.new_full((len(labels), 3), FIRST_REFLECTANCE)
        return MetalEvidence(none, none, gray, torch.zeros_like(gray), labels)
    looks = view_sums(gaussians, memory.between(measured), rasterize, limits)
    result = of_views(looks, labels, refractive_index, rules, limits)
    del looks
    memory.clear()
    return result


def of_views(
    looks: Sequence[Tensor], labels: Tensor, refractive_index: float, rules: MetalRules, limits: MetalViews
) -> MetalEvidence:
    """Evidence of what views measured, as of ``view_sums``, and of the user's labels."""
    sums = torch.stack([look.sum(dim=0) for look in looks]).sum(dim=0)
    light = float(sums[1:4].mean() / sums[0].clamp(min=1e-6))
    parts = []
    for begin in range(0, len(labels), CHUNK):
        samples = samples_of(looks, slice(begin, begin + CHUNK), limits)
        total = samples.weight.sum(dim=0)
        count = total * total / (samples.weight**2).sum(dim=0).clamp(min=1e-9) * (total > LEAST_PIXELS)
        color = (samples.weight[..., None] * samples.s0).sum(dim=0) / total.clamp(min=1e-6)[:, None]
        parts.append((*errors(samples, refractive_index, light, limits.dark), count, color, total))
    dielectric, metal, reflectance, count, color, total = (
        torch.cat(values) for values in zip(*parts, strict=True)
    )
    typical = torch.minimum(dielectric, metal)[count > UNKNOWNS]
    error = typical.median().clamp(min=NOISE) if len(typical) else dielectric.new_tensor(1.0)
    ratio = ((error + dielectric) / (error + metal)).log() - _tint_cost(color, total, rules)
    return MetalEvidence(ratio, (count - UNKNOWNS).clamp(min=0), reflectance, color.clamp(min=0), labels)


def _tint_cost(color: Tensor, weight: Tensor, rules: MetalRules) -> Tensor:
    """What it costs a metal [N] to be more deeply colored than gold in the mean light of the scene, in nats a view."""
    mean = (color * weight[:, None]).sum(dim=0) / weight.sum().clamp(min=1e-6)
    tints = (color / mean.clamp(min=1e-6)).clamp(min=1e-3)
    tint = (tints.amin(dim=1) / tints.amax(dim=1)).log()
    return 0.5 * ((math.log(GOLD) - tint).clamp(min=0) / rules.tint) ** 2
