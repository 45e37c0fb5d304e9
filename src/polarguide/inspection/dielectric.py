"""Whether a capture shows more polarization than dielectrics under unpolarized light can have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from polarguide import optics
from polarguide.inspection.readings import Readings
from polarguide.inspection.surfaces import ZENITH_MARGIN, Pixels
from polarguide.inspection.verdict import Check, Verdict

NOT_DIELECTRIC = 0.15
"""Share of the pixels with normals, or of all, that no dielectric under unpolarized light explains."""


def dielectric_check(readings: Sequence[Readings], pixels: Pixels | None, index: float) -> Check:
    """Whether large areas are polarized more, or otherwise, than a dielectric under unpolarized light can be."""
    key, title = "dielectric", "Polarization that a dielectric can have"
    above = float(torch.tensor([r.above_limit for r in readings]).median())
    limit = float(optics.diffuse_dolp_limit(index))
    said = (
        f"{above:.0%} of the pixels (median view) are polarized more than diffuse light can be ({limit:.2f})."
    )
    figures: dict[str, Any] = {"above_diffuse_limit": above}
    remedy = (
        "Bare metal, sky or its reflection, or a screen? The model takes surfaces for dielectrics under unpolarized "
        "light: leave such areas out with masks, and trust normals there less."
    )
    if pixels is None or len(pixels.aolp) == 0:
        verdict: Verdict = "warning" if above > NOT_DIELECTRIC else "ok"
        said += " Without normals, reflections of a smooth dielectric cannot be told from metal or sky."
        return Check(key, title, verdict, said, remedy if verdict == "warning" else "", figures=figures)
    strange = float(unexplained(pixels, index).float().mean())
    figures["unexplained"] = strange
    said += f" Of the pixels with a normal, {strange:.0%} are polarized more than either lobe can be at their zenith."
    if strange <= NOT_DIELECTRIC:
        return Check(key, title, "ok", said, figures=figures)
    return Check(key, title, "warning", said, remedy, figures=figures)


def unexplained(pixels: Pixels, index: float) -> torch.Tensor:
    """[N] bool: a DoLP above that of specular and of diffuse light at every zenith within the margin."""
    steps = torch.linspace(-ZENITH_MARGIN, ZENITH_MARGIN, 7)
    zenith = (pixels.zenith[:, None] + steps).clamp(0, math.pi / 2)
    most = torch.maximum(optics.specular_dolp(zenith, index), optics.diffuse_dolp(zenith, index)).amax(dim=1)
    return pixels.dolp > most + 3 * pixels.noise
