"""What all views measured of a Gaussian is explained twice: as a dielectric, and as a metal.

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

import torch
from torch import Tensor

from polarguide import optics
from polarguide.training.metals.looks import Seen
from polarguide.training.metals.rules import MetalRules


def _relative(seen: Seen, dark: float) -> tuple[Tensor, Tensor]:
    """Weights [V, N, 3] of squares, and what their sums over the views are relative to [N, 3]."""
    above = seen.s0.clamp(min=0) + dark  # the variance of light that is counted grows with the light
    weight = seen.weight[..., None] / above
    return weight, (weight * above * above).sum(dim=0).clamp(min=1e-9)


def residuals(seen: Seen, refractive_index: float, rules: MetalRules) -> tuple[Tensor, Tensor, Tensor]:
    """Mean squares of the relative residuals of a dielectric and of a metal [N], and the metal's reflectance [N, 3]."""
    s0, across, cosine = seen.s0, seen.across, seen.cosine[..., None]
    sine2 = 1 - cosine * cosine
    weight, scale = _relative(seen, rules.dark)
    specular, diffuse = (slope * sine2 for slope in optics.dolp_slopes(cosine, refractive_index))
    seen_body, of_body = specular * s0 - across, specular + diffuse
    by_line = weight / (1 + specular * specular)
    body = (by_line * of_body * seen_body).sum(dim=0) / (by_line * of_body**2).sum(dim=0).clamp(min=1e-9)
    misfit = (by_line * (seen_body - of_body * body.clamp(min=0)) ** 2).sum(dim=0) / scale
    color = (seen.weight[..., None] * s0).sum(dim=0)
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


def oblique_light(seen: Seen, dark: float) -> Tensor:
    """Mean squares [N] of the polarization at 45 degrees to the plane of incidence, relative like the residuals."""
    weight, scale = _relative(seen, dark)
    return ((weight * seen.oblique**2).sum(dim=0) / scale).mean(dim=1)
