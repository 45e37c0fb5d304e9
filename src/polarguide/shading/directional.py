"""Deferred shading by directional factorization (Ref-GS, Zhang et al. 2025), with a grid of learned feature vectors.

Splatted channels are albedo (3), normal (3), roughness (1) and a feature vector (4). With ``w`` the view ray mirrored
at the blended normal and ``r`` the roughness, a pixel has

    h = grid(w, level = L r)
    specular = exp(min(MLP(h, h x f), 5))
    final = albedo + specular

in linear radiance. The grid is a learned cubemap of 16 channels with L box-filtered levels, f the blended feature at
unit length, and h x f an outer product of 64 values. The MLP has two hidden layers with ReLU. The albedo is independent
of the view.

Surroundings do not reflect. A Gaussian that started farther away than the cameras has a ``surface`` of 0, and splats
the color of its harmonics instead of the albedo. Specular light of a pixel is multiplied by the share of its alpha that
Gaussians with a ``surface`` of 1 contribute. (For real scenes, the release separates both by a sphere that the user
specifies.)
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
    mirrored,
)
from polarguide.shading.surface import SurfaceProperty

CHANNELS = 16
"""Number of channels of the grid."""
FEATURES = 4
"""Number of features of a Gaussian."""
INPUTS = CHANNELS * (1 + FEATURES)
"""Number of inputs of the MLP."""
ALBEDO_SCALE = 0.2
"""Scale of the albedo as in the release; its maximum is e^5 / 5, about 30 times display white."""
MINIMUM_ALPHA = 0.05
"""Alpha of a pixel below which it has no specular light."""
_DARKEST = 1e-3
"""Least initial albedo, so that the logarithm of a black point is finite."""


def _albedo(logarithms: Tensor) -> Tensor:
    return ALBEDO_SCALE * logarithms.clamp(max=MAXIMUM_LOG_LIGHT).exp()


@dataclass(frozen=True)
class DirectionalShading(ShadingModel):
    """Shading model in which a small network converts learned feature vectors to reflected light; see the module.

    Attributes:
        width: width of the MLP's two hidden layers.
        mlp_rate: learning rate of the MLP.
        albedo_rate: learning rate of the albedo.
        feature_rate: learning rate of roughness and features.
        first_albedo: initial albedo as a share of the colors of the initial points, in (0, 1].
        first_roughness: roughness before the first step, in (0, 1).
        first_light: specular radiance before the first step; its logarithm is the output bias of the MLP.
        environment_spread: largest absolute value of the initial texels, which are uniform random numbers.
        environment_rate: learning rate of the texels.
        environment_resolution: number of texels along the side of a cube face, a power of two.
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
    def surface(self) -> tuple[SurfaceProperty, ...]:
        """Albedo, roughness, feature vector, and ``surface``, which is 0 or 1 and not trained."""
        rate = self.feature_rate
        return (
            SurfaceProperty("albedo", "log_albedo", channels=3, activation=_albedo, rate=self.albedo_rate),
            SurfaceProperty("roughness", "roughness_logits", activation=torch.sigmoid, rate=rate),
            SurfaceProperty("feature", "features", channels=FEATURES, activation=torch.tanh, rate=rate),
            SurfaceProperty("surface", "surface"),
        )

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the grid and of the MLP.

        The grid has ``texels`` [6, R, R, 16]. Layer K = 0, 1, 2 of the MLP has ``mlp_weight_K`` [inputs, outputs] and
        ``mlp_bias_K`` [outputs].
        """
        side = self.environment_resolution
        table = {"texels": Parameter((6, side, side, CHANNELS), self.environment_rate)}
        for layer, (inputs, outputs) in enumerate(pairwise((INPUTS, self.width, self.width, 3))):
            table[f"mlp_weight_{layer}"] = Parameter((inputs, outputs), self.mlp_rate)
            table[f"mlp_bias_{layer}"] = Parameter((outputs,), self.mlp_rate)
        return table

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the initial values of all parameters.

        The albedo follows from the colors. All Gaussians have the same roughness, and their features are random.
        ``surface`` is 1 unless a Gaussian is ``far``. The texels are uniform random numbers. Weights of the MLP are
        uniform within 1 / sqrt(inputs), as in ``torch.nn.Linear``.
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
        """Return the specular radiance [P, 3], with values in (0, e^5].

        Args:
            light: the parameters in ``light_parameters``.
            directions: [P, 3] mirrored rays, of any length.
            roughness: [P] in [0, 1]. With L mip levels, values of at least ``1 - 1 / L`` read the mean of the grid.
            features: [P, 4] feature vectors of any length. Vectors of zero length have no effect.
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

    def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
        """Return the channels to splat: color, ``blur``, ``feature`` and ``surface``.

        The color is the albedo. For Gaussians with a ``surface`` of 0, the color is the color of the harmonics, and the
        other channels are 0.
        """
        surface = gaussians["surface"].detach()[:, None]
        colors = torch.where(
            surface > 0, _albedo(gaussians["log_albedo"]), base_colors(gaussians, center, degree)
        )
        further = {
            "blur": surface * torch.sigmoid(gaussians["roughness_logits"])[:, None],
            "feature": surface * torch.tanh(gaussians["features"]),
            "surface": surface,
        }
        return Channels(colors, further=further)

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        """Return the layers ``final``, ``specular`` and ``diffuse``, each [H, W, 3].

        The diffuse layer is the splatted color.
        """
        albedo = splatted["color"]
        alpha = splatted.alpha
        rays = camera.world_rays(dtype=albedo.dtype, device=albedo.device)
        directions = mirrored(rays, unit(splatted["normal"], 1e-3))
        radiance = self.radiance(
            light,
            directions.reshape(-1, 3),
            splatted["blur"].flatten(),
            splatted["feature"].reshape(-1, FEATURES),
        ).reshape(albedo.shape)
        share = (splatted["surface"][..., 0] / alpha.clamp(min=MINIMUM_ALPHA)).clamp(max=1)
        specular = radiance * (share * (alpha > MINIMUM_ALPHA))[..., None]
        return {"final": albedo + specular, "specular": specular, "diffuse": albedo}
