"""Check for polarization that dielectrics under unpolarized light cannot have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from polarguide import optics
from polarguide.inspection.measurements import ViewMeasurements
from polarguide.inspection.surfaces import ZENITH_MARGIN, SurfaceSamples
from polarguide.inspection.verdict import Check, Verdict

NOT_DIELECTRIC = 0.15
"""Share of the pixels with normals, or of all pixels, above which the check warns."""


def dielectric_check(
    measurements: Sequence[ViewMeasurements], pixels: SurfaceSamples | None, index: float
) -> Check:
    """Check whether large areas are polarized more strongly than a dielectric under unpolarized light can be."""
    key, title = "dielectric", "Polarization that a dielectric can have"
    above = float(torch.tensor([r.above_limit for r in measurements]).median())
    limit = float(optics.diffuse_dolp_limit(index))
    said = f"{above:.0%} of the pixels (median view) have a DoLP above the diffuse limit ({limit:.2f})."
    figures: dict[str, Any] = {"above_diffuse_limit": above}
    remedy = (
        "Bare metal, sky or its reflection, or a screen? The model assumes dielectrics under unpolarized light: "
        "exclude such areas with masks, and expect worse normals there."
    )
    if pixels is None or len(pixels.aolp) == 0:
        verdict: Verdict = "warning" if above > NOT_DIELECTRIC else "ok"
        said += (
            " Without normals, reflections of a smooth dielectric cannot be distinguished from metal or sky."
        )
        return Check(key, title, verdict, said, remedy if verdict == "warning" else "", figures=figures)
    strange = float(exceeds_dielectric(pixels, index).float().mean())
    figures["unexplained"] = strange
    said += f" Of the pixels with a normal, {strange:.0%} have a DoLP above the maximum of both lobes at their zenith."
    if strange <= NOT_DIELECTRIC:
        return Check(key, title, "ok", said, figures=figures)
    return Check(key, title, "warning", said, remedy, figures=figures)


def exceeds_dielectric(pixels: SurfaceSamples, index: float) -> torch.Tensor:
    """Whether the DoLP exceeds that of specular and diffuse light at every zenith within the margin, [N] bool."""
    steps = torch.linspace(-ZENITH_MARGIN, ZENITH_MARGIN, 7)
    zenith = (pixels.zenith[:, None] + steps).clamp(0, math.pi / 2)
    most = torch.maximum(optics.specular_dolp(zenith, index), optics.diffuse_dolp(zenith, index)).amax(dim=1)
    return pixels.dolp > most + 3 * pixels.noise
