"""Directional factorization (Ref-GS, Zhang et al. 2025), deferred: light of a learned grid of feature vectors.

One alpha blend splats albedo (3), normal (3), roughness (1) and a feature (4). Per pixel, with ``w`` the view ray
mirrored at the blended normal and ``r`` the roughness,

    h = grid(w, level = L r)                  16 values of a learned cubemap with L box-filtered levels
    specular = exp(min(MLP(h, h x f), 5))     f the blended feature at unit length, h x f their outer product (64)
    final = albedo + specular

in linear radiance. The MLP has two hidden layers with ReLU. The albedo does not depend on the view.

Surroundings are no surface that reflects: a Gaussian that began farther away than the cameras (``surface`` 0) splats
its harmonics in place of the albedo, and the specular light of a pixel counts by the share of its alpha that Gaussians
with a surface have. (The release blends the two on real scenes by a sphere that the user gives.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import relu

from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import unit
from polarguide.shading.cubemap import box_mips, mip_lookup
from polarguide.shading.model import (
    MAXIMUM_LOG_LIGHT,
    Channels,
    GBuffer,
    Light,
    Parameter,
    Parameters,
    ShadingModel,
    base_colors,
    harmonic_colors,
    mirrored,
)

CHANNELS = 16
FEATURES = 4
INPUTS = CHANNELS * (1 + FEATURES)
# Brightest albedo is e^5 / 5, about 30 times display white (the release's scale).
ALBEDO_SCALE = 0.2
# Pixels with less alpha than this get no specular light: there is no surface to reflect it.
MINIMUM_ALPHA = 0.05
_DARKEST = 1e-3  # a black point's first albedo, so that its logarithm is finite


def albedo_of(gaussians: Parameters) -> Tensor:
    """Albedo [N, 3], ``exp(min(x, 5)) / 5`` of the parameter ``log_albedo``."""
    return ALBEDO_SCALE * gaussians["log_albedo"].clamp(max=MAXIMUM_LOG_LIGHT).exp()


@dataclass(frozen=True)
class DirectionalShading(ShadingModel):
    """Light of a learned grid of feature vectors that a small network reads; see the module's text.

    Attributes:
        width: width of the MLP's two hidden layers.
        mlp_rate: learning rate of the MLP.
        albedo_rate: learning rate of the albedo. feature_rate: of roughness and features.
        first_albedo: share of the first points' colors that albedo begins with, in (0, 1].
        first_roughness: that Gaussians begin with, in (0, 1).
        first_light: specular radiance before the first step (the MLP's output bias is its logarithm).
        environment_spread: first texels of the grid are uniform in plus or minus this.
        environment_rate: learning rate of the texels.
        environment_resolution: texels along a cube face's side, a power of two.
    """

    width: int = 256
    mlp_rate: float = 5e-4
    albedo_rate: float = 1e-3
    feature_rate: float = 2e-3
    first_albedo: float = 0.5
    first_roughness: float = 0.5
    first_light: float = 0.25
    environment_spread: float = 5.0
    environment_rate: float = 0.05
    environment_resolution: int = 128

    stream: ClassVar[int] = 5

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """``log_albedo`` [N, 3], ``roughness_logits`` [N], ``features`` [N, 4]; ``surface`` [N] keeps its 1 or 0."""
        return {
            "log_albedo": Parameter((3,), self.albedo_rate),
            "roughness_logits": Parameter((), self.feature_rate),
            "features": Parameter((FEATURES,), self.feature_rate),
            "surface": Parameter((), 0.0),
        }

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """``texels`` [6, R, R, 16], and ``mlp_weight_K`` [inputs, outputs], ``mlp_bias_K`` [outputs], K = 0, 1, 2."""
        side = self.environment_resolution
        table = {"texels": Parameter((6, side, side, CHANNELS), self.environment_rate)}
        for layer, (inputs, outputs) in enumerate(pairwise((INPUTS, self.width, self.width, 3))):
            table[f"mlp_weight_{layer}"] = Parameter((inputs, outputs), self.mlp_rate)
            table[f"mlp_bias_{layer}"] = Parameter((outputs,), self.mlp_rate)
        return table

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Albedo from the colors, one roughness, random features, and a surface where the position is not ``far``.

        The light has uniform texels, and an MLP that is uniform within 1 / sqrt(inputs), as torch's Linear.
        """
        count = colors.shape[0]
        albedo = (self.first_albedo * colors).clamp(min=_DARKEST)
        logit = math.log(self.first_roughness / (1 - self.first_roughness))
        first = {
            "log_albedo": torch.log(albedo / ALBEDO_SCALE),
            "roughness_logits": torch.full((count,), logit),
            "features": torch.randn(count, FEATURES, generator=generator),
            "surface": (~far).float(),
        }
        table = self.light_parameters

        def uniform(name: str, bound: float) -> Tensor:
            return (torch.rand(table[name].shape, generator=generator) * 2 - 1) * bound

        values = {"texels": uniform("texels", self.environment_spread)}
        for layer in range(3):
            bound = 1 / math.sqrt(table[f"mlp_weight_{layer}"].shape[0])
            for name in (f"mlp_weight_{layer}", f"mlp_bias_{layer}"):
                values[name] = uniform(name, bound)
        values["mlp_bias_2"] = torch.full((3,), math.log(self.first_light))
        return first, values

    def radiance(self, light: Light, directions: Tensor, roughness: Tensor, features: Tensor) -> Tensor:
        """Specular radiance [P, 3], in (0, e^5].

        Args:
            light: parameters as of ``light_parameters``.
            directions: [P, 3] mirrored rays, of any length.
            roughness: [P] in [0, 1]; from ``1 - 1 / L`` on, with L mip levels, it reads the mean of the grid.
            features: [P, 4] of any length; zero reads the light without them.
        """
        levels = box_mips(light["texels"])
        looked_up = mip_lookup(levels, directions, len(levels) * roughness)
        squared = features.square().sum(dim=-1, keepdim=True)
        factors = features * torch.rsqrt(squared.clamp(min=1e-6))
        outer = (looked_up[:, :, None] * factors[:, None, :]).flatten(1)
        hidden = torch.cat((looked_up, outer), dim=1)
        for layer in (0, 1):
            hidden = relu(torch.addmm(light[f"mlp_bias_{layer}"], hidden, light[f"mlp_weight_{layer}"]))
        out = torch.addmm(light["mlp_bias_2"], hidden, light["mlp_weight_2"])
        return out.clamp(max=MAXIMUM_LOG_LIGHT).exp()

    def channels(self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int) -> Channels:
        """Albedo, or harmonics without a surface, as ``color`` [N, 3]; ``blur`` [N, 1], ``feature`` [N, 4] and
        ``surface`` [N, 1].

        Without a surface the latter are 0.
        """
        surface = gaussians["surface"].detach()[:, None]
        colors = torch.where(surface > 0, albedo_of(gaussians), base_colors(gaussians, center, degree))
        blur = torch.sigmoid(gaussians["roughness_logits"])[:, None]
        feature = torch.tanh(gaussians["features"])
        return {
            "color": colors,
            "blur": surface * blur,
            "feature": surface * feature,
            "surface": surface,
        }

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        """``final``, ``specular`` and ``diffuse`` [H, W, 3]; the color that was splatted is the diffuse one."""
        albedo = splatted["color"]
        normal = splatted["normal"]
        alpha = splatted.alpha
        rays = camera.world_rays(dtype=albedo.dtype, device=albedo.device)
        directions = mirrored(rays, unit(normal, 1e-3))
        radiance = self.radiance(
            light,
            directions.reshape(-1, 3),
            splatted["blur"].flatten(),
            splatted["feature"].reshape(-1, FEATURES),
        ).reshape(albedo.shape)
        share = (splatted["surface"][..., 0] / alpha.clamp(min=MINIMUM_ALPHA)).clamp(max=1)
        specular = radiance * (share * (alpha > MINIMUM_ALPHA))[..., None]
        return {"final": albedo + specular, "specular": specular, "diffuse": albedo}

    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Each Gaussian shaded alone, at its own normal, roughness and feature: linear colors [N, 3].

        Args:
            rays: [N, 3] unit. normals: [N, 3] unit, facing them.
        """
        roughness = torch.sigmoid(gaussians["roughness_logits"])
        features = torch.tanh(gaussians["features"])
        specular = self.radiance(light, mirrored(rays, normals), roughness, features)
        return self.diffuse_colors(gaussians, rays) + gaussians["surface"][:, None] * specular

    def diffuse_colors(self, gaussians: Parameters, rays: Tensor) -> Tensor:
        """Albedo, or harmonics without a surface [N, 3]."""
        surface = gaussians["surface"][:, None] > 0
        return torch.where(surface, albedo_of(gaussians), harmonic_colors(gaussians, rays))
