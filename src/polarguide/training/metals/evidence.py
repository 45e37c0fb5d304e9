"""Evidence of metals: log likelihood ratio of metal and dielectric for each Gaussian.

At a Gaussian, a view measures S0 and, per color, the polarization P across the rendered normal's plane of incidence and
U at 45 degrees to it. ``rho`` are Fresnel's degrees of polarization.

- The body light d of a dielectric is the same from everywhere, and its specular light s is free: ``S0 = d + s``,
  ``P = k rho_s s - rho_d d``. Roughness leaves the share k of the polarization, from ``ROUGH`` to 1.
- A metal mirrors free light and polarizes it according to its reflectance r: ``P = rho(r) S0``. Its color is that of
  the mirrored light times r, so that r follows the observed color.

Unpolarized light has no U. Polarized light changes P about as much as U. A metal preserves at most the share
``conductor_oblique_share`` of U (aluminum 0.98 at 45 degrees and 0.91 at 60; copper and gold 0.57 at 60 and 0.1 at 70).
A dielectric preserves at most ``sqrt(Rs Rp)`` times the light of the scene. Each hypothesis reduces its error
in P by the part of U that it explains, and the rest of U is an error.

The errors E are mean squares relative to the light, in n views of unknown variance. With e the typical error of the
scene, a lower bound of all errors, they give the log likelihood ratio
``n log((e^2 + E_dielectric) / (e^2 + E_metal))``: n/2 for each of P and U.
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

ROUGH = (1.0, 0.85, 0.7, 0.55)
"""Shares of the specular polarization that roughness of a dielectric may leave."""
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.95)
"""Levels of the tested reflectances, which are a level times a power of the observed color."""
POWERS = (0.5, 0.75, 1.0)
"""Powers of the observed color in the tested reflectances."""
GOLD = 0.38
"""Smallest over largest reflectance of the most deeply colored metal, gold."""
UNKNOWNS = 2
"""Number of unknowns of either hypothesis, which determine the same number of views."""
NOISE = 1e-4
"""Lower bound of the typical error of a scene: mean square of the noise of the views, relative to the light."""
CHUNK = 1 << 14
"""Batch size in Gaussians, which bounds the memory of intermediate tensors."""


class Errors(NamedTuple):
    """Errors of both hypotheses.

    Attributes:
        dielectric, metal: [N] mean squares relative to the light.
        reflectance: [N, 3] reflectance of the metal.
    """

    dielectric: Tensor
    metal: Tensor
    reflectance: Tensor


class MetalEvidence(NamedTuple):
    """Evidence of the views for N Gaussians.

    Attributes:
        ratio: [N] log likelihood ratio of metal and dielectric, per view.
        views: [N] number of independent views.
        reflectance: [N, 3] reflectance of the best metal.
        color: [N, 3] mean S0.
        labels: [N, 2] weight of pixels that the user labels as dielectric and as metal.
    """

    ratio: Tensor
    views: Tensor
    reflectance: Tensor
    color: Tensor
    labels: Tensor


def errors(samples: ViewSamples, refractive_index: float, light: float, dark: float) -> Errors:
    """Return the errors of both hypotheses for N Gaussians.

    Args:
        samples: means over the views.
        refractive_index: refractive index of dielectrics.
        light: mean radiance of the scene, S0.
        dark: radiance added to the reference of relative errors.
    """
    s0 = samples.s0
    across = samples.across
    cosine = samples.cosine[..., None]
    sine2 = 1 - cosine * cosine
    above = s0.clamp(min=0) + dark  # the variance of photon counts grows with the light
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
        excess = over * s0 - across
        body = (by_line * of_body * excess).sum(dim=0) / (by_line * of_body**2).sum(dim=0).clamp(min=1e-9)
        bodies.append(mean((excess - of_body * body.clamp(min=0)) ** 2 / (1 + over * over)))
    color = (samples.weight[..., None] * s0).sum(dim=0)
    color = (color / color.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(min=0.05)
    oblique = mean(samples.oblique**2)

    def excused(error: Tensor, largest: Tensor) -> Tensor:
        """Subtract the part of an error that an oblique polarization up to ``largest`` explains, and add the excess."""
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
    """Return the evidence of the views for each Gaussian; see ``training.metals.evidence``.

    Views whose pictures do not determine the Stokes vector only contribute the labels of the user.
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
    """Return the evidence of the sums of ``view_sums`` and of the labels of the user."""
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
    """Return the cost [N] of a metal that is more deeply colored than gold in the mean light of the scene.

    The unit is nats per view.
    """
    mean = (color * weight[:, None]).sum(dim=0) / weight.sum().clamp(min=1e-6)
    tints = (color / mean.clamp(min=1e-6)).clamp(min=1e-3)
    tint = (tints.amin(dim=1) / tints.amax(dim=1)).log()
    return 0.5 * ((math.log(GOLD) - tint).clamp(min=0) / rules.tint) ** 2
