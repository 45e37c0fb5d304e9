"""Roughness of surfaces: which mip level of the environment they mirror, and how rough that is for a renderer.

A Gaussian's roughness r in [0, 1] stands for level ``LEVELS r`` of the box-filtered radiance. What a pixel shows has
the mean of the Gaussians that it blends. A level blurs as GGX's lobe (Walter et al. 2007) does whose width, at half its
height, is that of the level's texels: 147 degrees times alpha, for lobes that are not wide. So

    alpha = 2^(LEVELS r) (90 degrees / R) / (147 degrees)

with R texels along a face's side. With 32 a mirror has 0.019, which its own texel blurs, and a roughness of 1 has 0.31.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.cubemap import box_mips
from polarguide.shading.model import GBuffer

LEVELS = 4
"""Mip levels from a mirror to a roughness of 1."""
LOBE_WIDTH = 147.0
"""Degrees of GGX's lobe at half its height, over its alpha."""


def light_levels(radiance: Tensor) -> list[Tensor]:
    """Levels of radiance from afar [6, R, R, 3], from a mirror's to that of a roughness of 1."""
    return box_mips(radiance)[: LEVELS + 1]


def ggx_alpha(roughness: Tensor, resolution: int) -> Tensor:
    """GGX's alpha of roughness in [0, 1], with so many texels along a face's side."""
    return torch.exp2(LEVELS * roughness) * (90 / resolution / LOBE_WIDTH)


def gltf_roughness(roughness: Tensor, resolution: int) -> Tensor:
    """The square root of GGX's alpha, which glTF calls roughness; without a gradient."""
    return ggx_alpha(roughness.detach(), resolution).sqrt()


def blended_roughness(splatted: GBuffer) -> Tensor | None:
    """Roughness [H, W], blended over the Gaussians of each pixel; 0 for a mirror, and for a pixel without Gaussians.

    None if the shading model has no roughness.
    """
    if "roughness" not in splatted.layout:
        return None
    return splatted["roughness"][..., 0] / splatted.alpha.detach().clamp(min=1e-6)
