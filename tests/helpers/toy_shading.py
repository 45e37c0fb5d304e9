"""A shading model and a recipe as a plug-in has them: mirrors under a sky of two colors. No other file knows of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import unit
from polarguide.methods import RECIPES
from polarguide.shading.model import (
    Channels,
    GBuffer,
    Light,
    Parameter,
    Parameters,
    ShadingModel,
    mirrored,
)
from polarguide.training.recipe import Stage, Weights


@dataclass(frozen=True)
class SkyShading(ShadingModel):
    """final = base + gloss sky(mirrored ray), in linear radiance; the sky goes from one color to another.

    Attributes:
        first_gloss: that Gaussians begin with, in (0, 1). sky_rate: learning rate of the two colors.
    """

    first_gloss: float = 0.2
    sky_rate: float = 0.02

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        return {"gloss_logits": Parameter((), 0.01, reset_minimum=-5.0), "tint": Parameter((3,), 0.01)}

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        return {"sky": Parameter((2, 3), self.sky_rate)}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        logit = torch.logit(torch.tensor(self.first_gloss))
        first = {"gloss_logits": logit.expand(len(colors)).clone(), "tint": torch.ones(len(colors), 3)}
        return first, {"sky": 0.1 * torch.rand(2, 3, generator=generator) - 1}

    @property
    def layers(self) -> tuple[str, ...]:
        return ("final", "base", "specular", "diffuse", "strength", "normal", "depth", "alpha")

    def sky(self, light: Light, directions: Tensor) -> Tensor:
        """Radiance [..., 3] from directions [..., 3]."""
        above = 0.5 - 0.5 * directions[..., 1:2]
        return torch.exp(torch.lerp(light["sky"][0], light["sky"][1], above))

    def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
        gloss = torch.sigmoid(gaussians["gloss_logits"])[:, None]
        return Channels(further={"gloss": gloss, "mirror": gloss * gaussians["tint"]})

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        base, normal = splatted["color"], splatted["normal"]
        rays = camera.world_rays(dtype=base.dtype, device=base.device)
        specular = splatted["mirror"] * self.sky(light, mirrored(rays, unit(normal, 1e-3)))
        strength = splatted["gloss"][..., 0]
        return {"final": base + specular, "specular": specular, "diffuse": base, "strength": strength}


_BASE = RECIPES["polarguide"]
TOY = replace(
    _BASE,
    name="toy",
    about="Mirrors under a sky of two colors.",
    shading=SkyShading(),
    stages=(
        Stage("plain", 0.2, reflection=False, densify=True),
        Stage(
            "mirrors",
            0.8,
            reflection=True,
            weights=Weights(specular=0.2, stokes=0.1, azimuth=0.1),
            densify=True,
            on_enter=("refresh_priors",),
        ),
    ),
    initialization=replace(_BASE.initialization, shell=50),
    densification=replace(_BASE.densification, every=8, gradient=1e-5, pixels_each=1.0),
)


def recipes() -> tuple:
    """What the plug-in offers: the recipe and an ablation."""
    return TOY, replace(TOY, name="toy:dull", shading=replace(TOY.shading, first_gloss=0.01))
