"""How bright the light is, as metals show it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from polarguide.capture import View
from polarguide.gaussians.gaussians import Gaussians
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import render
from polarguide.shading.model import Light, ShadingModel
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.metals.looks import evenly
from polarguide.training.metals.rules import MetalRules


@torch.no_grad()
def light_gain(
    gaussians: Gaussians,
    light: Light,
    views: Sequence[View],
    rasterize: Rasterize,
    shading: ShadingModel,
    rules: MetalRules,
    memory: MemoryBound = UNBOUNDED,
) -> float:
    """By how much the light should be brighter, as the first metals show it.

    Dielectrics fix the product of strength and light alone. Metals, whose reflectance is known, fix the light.

    Returns:
        The median of what they show over what is rendered of them; 1 without views and where they are hardly seen. Not
        so little that strengths would have to exceed 1.
    """
    ratios, pixels = [], 0
    for view in memory.between(evenly(views, rules.gain_views)):
        shown = view.photograph().to(gaussians["means"].device).flatten(0, 1)
        metal = render(gaussians, view.camera, rasterize, shading=shading, light=light).metal
        pixels += len(shown)
        if metal is None:
            continue
        clear = (metal.share > rules.gain_share) & ~(view.saturated | view.invalid).to(
            shown.device
        ).flatten()[metal.pixels]
        rendered = metal.specular[clear].mean(dim=1) / metal.share[clear]
        ratios.append(((shown[metal.pixels[clear]].mean(dim=1) + 1e-3) / (rendered + 1e-3)).log())
    found = torch.cat(ratios) if ratios else gaussians["means"].new_zeros(0)
    if not len(found) or len(found) < rules.gain_pixels * pixels:
        return 1.0
    body = gaussians["metalness"] == 0
    least = (
        torch.quantile(shading.strength(gaussians)[body], 0.9) if bool(body.any()) else found.new_tensor(0.1)
    )
    return float(found.median().exp().clamp(min=float(least), max=rules.most_gain))
