"""PolGS (Han et al., ICCV 2025): a polarimetric baseline with Gaussian surfels and a cubemap.

The picture is the sum of two layers, a diffuse color D and mirrored light E:

    S0 = D + E
    (S1, S2) = (rho_s E - rho_d D) (cos, sin)(2 (azimuth + pi/2))

rho_s and rho_d are Fresnel's degrees of polarization at the blended normal. D does not depend on the view. E is a
learned cubemap in the mirrored direction, without a reflectance. The terms on S1 and S2 see both layers as constants,
so they only move normals.

PolGS reconstructs a masked object. Here, surroundings are Gaussians that start farther away than the cameras. They have
a ``surface`` of 0, do not reflect, and have the color of their harmonics. ``docs/explanation/baselines.md`` lists all
differences from the publication and its release.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.gaussians.gaussians import Parameters
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.methods.baselines import RATES
from polarguide.methods.polarguide import BEHIND
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.model import (
    Channels,
    GBuffer,
    Light,
    Parameter,
    RadianceCubemap,
    ShadingModel,
    mirrored,
)
from polarguide.shading.result import RenderResult
from polarguide.shading.surface import SurfaceProperty
from polarguide.training.losses import Weights, term
from polarguide.training.recipe import Priors, Recipe, Stage
from polarguide.training.targets import Step

_SURFACE = SurfaceProperty("surface", "surface")
_DARKEST = 1e-4
"""Radiance of black, so that its raw texel is finite."""
UNCERTAIN = ((0.01, 0.2, 0.01), (0.2, 0.8, 1.0), (0.8, 0.99, 0.01))
"""Ranges of opacity and their weights in the opacity term of the release."""
COVERED = 1e-5
"""Alpha above which the release counts a pixel as covered."""


@dataclass(frozen=True)
class AdditiveShading(ShadingModel):
    """Shading model of PolGS: the sum of a diffuse color and mirrored light.

    Attributes:
        first_light: radiance of the environment before the first step, in (0, 1).
        environment_spread: largest deviation of the first raw texels from ``first_light``; they are uniform random
            numbers.
        environment_rate: learning rate of the texels.
        environment_resolution: number of texels along the side of a cube face.
        first_strength: initial factor on mirrored light, which each Gaussian learns. With None, all surfaces mirror the
            full environment, as in PolGS.
        strength_rate: learning rate of this factor.
    """

    first_light: float = 0.5
    environment_spread: float = 5.0
    environment_rate: float = 0.05
    environment_resolution: int = 128
    first_strength: float | None = None
    strength_rate: float = 6e-3

    @property
    def surface(self) -> tuple[SurfaceProperty, ...]:
        """``surface``, which is 0 for surroundings and not learned, and the strength if it is learned."""
        if self.first_strength is None:
            return (_SURFACE,)
        strength = SurfaceProperty(
            "strength",
            "strength_logits",
            activation=torch.sigmoid,
            inverse=torch.logit,
            initial=self.first_strength,
            rate=self.strength_rate,
        )
        return (_SURFACE, strength)

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Raw ``texels`` [6, R, R, 3] of the environment."""
        side = self.environment_resolution
        radiance = RadianceCubemap(
            "texels", torch.sigmoid, lambda light: torch.logit(light.clamp(_DARKEST, 1 - _DARKEST))
        )
        return {"texels": Parameter((6, side, side, 3), self.environment_rate, radiance=radiance)}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return initial values: near Gaussians are surfaces, and texels are random around ``first_light``."""
        first, _ = super().initialize(colors, far, generator)
        uniform = torch.rand(self.light_parameters["texels"].shape, generator=generator) * 2 - 1
        middle = math.log(self.first_light / (1 - self.first_light))
        return first | {"surface": (~far).float()}, {"texels": middle + self.environment_spread * uniform}

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers; ``strength`` if it is learned."""
        learned = () if self.first_strength is None else ("strength",)
        return ("final", "base", "reflection", "specular", "diffuse", *learned, "normal", "depth", "alpha")

    def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
        """Return the channels to splat: the color, and ``share``, the factor on mirrored light.

        Only surroundings have a color that depends on the view.
        """
        share = gaussians["surface"].detach()[:, None]
        rest = (1 - share)[..., None] * gaussians["sh_rest"]
        color = evaluate_sh(gaussians["means"], center, gaussians["sh_dc"], rest, degree) + 0.5
        if self.first_strength is not None:
            share = share * torch.sigmoid(gaussians["strength_logits"])[:, None]
        return Channels(color.clamp(min=0), further={"share": share})

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """Return the layers ``final``, ``specular``, ``diffuse`` and ``reflection``, each [H, W, 3].

        ``strength`` [H, W] is added if it is learned. Normals that face away have no mirrored light.
        """
        diffuse = splatted["color"]
        rays = camera.world_rays(dtype=diffuse.dtype, device=diffuse.device)
        normal = unit(splatted["normal"], 1e-3)
        directions = mirrored(rays, normal).reshape(-1, 3)
        reflection = torch.sigmoid(cubemap_lookup(light["texels"], directions)).reshape(diffuse.shape)
        facing = dot(rays, normal)[..., None] < 0
        specular = facing * splatted["share"] * reflection
        layers = {
            "final": diffuse + specular,
            "specular": specular,
            "diffuse": diffuse,
            "reflection": reflection,
        }
        return layers if self.first_strength is None else layers | {"strength": splatted["share"][..., 0]}

    def predicted_stokes(self, result: RenderResult, camera: Camera) -> Tensor:
        """Predict Stokes vectors [3, H, W, 3] with a gradient on the normals only."""
        constant = {name: result.layers[name].detach() for name in ("specular", "diffuse")}
        return super().predicted_stokes(result.with_layers(**constant), camera)


@dataclass(frozen=True)
class SurfelWeights(Weights):
    """Weights of all loss terms, and of three terms of PolGS.

    Attributes:
        polarization: L1 distance of S1 and S2 on the scale of the picture.
        opacity: penalty of opacities between 0 and 1.
        curvature: Laplacian of the rendered normals.
    """

    polarization: float = term("stokes", "stokes_weight", rendered=("normal", "layers"))
    opacity: float = term()
    curvature: float = term(rendered=("normal",))

    def own_terms(self) -> Sequence[Callable[[Step, Any], Tensor | None]]:
        """Return the three terms."""
        return (polarization_term, opacity_term, curvature_term)


def polarization_term(step: Step, weights: SurfelWeights) -> Tensor | None:
    """Return the weighted sum of the L1 distances of S1/2 and S2/2, over reliable pixels."""
    priors = step.targets.priors
    if priors is None or not weights.polarization or "specular" not in step.shading.layers:
        return None
    predicted = step.shading.predicted_stokes(step.result, priors.camera)
    distance = (predicted[1:] - priors.stokes[1:]).abs().mean(dim=(0, -1))
    return weights.polarization * ((priors.stokes_weight > 0) * distance).mean()


def opacity_loss(opacities: Tensor) -> Tensor:
    """Return the mean of ``w exp(-20 (o - 1/2)^2)``, with the weights w of ``UNCERTAIN``.

    Args:
        opacities: [N] in [0, 1].
    """
    weight = torch.zeros_like(opacities)
    for low, high, value in UNCERTAIN:
        weight += value * ((opacities > low) & (opacities <= high))
    return (weight * torch.exp(-20 * (opacities - 0.5).square())).mean()


def opacity_term(step: Step, weights: SurfelWeights) -> Tensor | None:
    """Return the weighted loss of uncertain opacities."""
    if not weights.opacity:
        return None
    return weights.opacity * opacity_loss(torch.sigmoid(step.gaussians["opacity_logits"]))


def curvature_loss(normal: Tensor, alpha: Tensor) -> Tensor:
    """Return the mean absolute Laplacian of unit normals, summed over the three axes.

    A neighbor outside the picture or without Gaussians counts as equal.

    Args:
        normal: [H, W, 3] blended normals, any length.
        alpha: [H, W].
    """
    covered = (alpha.detach() > COVERED)[..., None]
    center = unit(normal, 1e-3) * covered

    def neighbors(picture: Tensor) -> list[Tensor]:
        framed = pad(picture.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
        return [framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:]]

    masks = neighbors(covered.to(normal))
    differences = (mask * (other - center) for other, mask in zip(neighbors(center), masks, strict=True))
    laplacian = torch.stack([*differences]).sum(dim=0)
    return (covered * laplacian).abs().sum(dim=-1).mean()


def curvature_term(step: Step, weights: SurfelWeights) -> Tensor | None:
    """Return the weighted curvature of the rendered normals."""
    if not weights.curvature or "normal" not in step.result.layers:
        return None
    return weights.curvature * curvature_loss(step.result.normal, step.result.alpha)


def _stages(count: int, densified: int) -> tuple[Stage, ...]:
    """Return stages of equal length. The weight of the consistency grows from one to the next, as in the release."""
    stages = [Stage("plain", 1 / count, reflection=False, densify=True)]
    for number in range(1, count):
        weights = SurfelWeights(
            polarization=5.0,
            opacity=0.01,
            curvature=0.005,
            flatness=0.1,
            consistency=0.01 + 0.1 * (number + 0.5) / count,
        )
        densify = number < densified
        name = f"{'densify' if densify else 'refine'} {number}"
        stages.append(
            Stage(name, 1 / count, reflection=True, weights=weights, densify=densify, behind=BEHIND)
        )
    return tuple(stages)


RECIPE_POLGS = Recipe(
    name="polgs",
    about="Gaussian surfels with diffuse color, a cubemap, and S1 and S2 that move the normals: PolGS.",
    stages=_stages(15, 8),
    rates=RATES,
    sh_fractions=(1 / 15, 2 / 15, 3 / 15),
    shading=AdditiveShading(
        first_light=0.02,
        environment_spread=0.2,
        environment_rate=0.01,
        environment_resolution=32,
    ),
    priors=Priors(bright=1e-3),  # normals and depth agree in all pixels that are not black
)
