"""Blur of reflections: the mip level of the environment that surfaces mirror, and its roughness for a renderer.

A Gaussian's blur b in [0, 1] stands for level ``LEVELS b`` of the box-filtered radiance. A pixel has the mean blur of
the Gaussians that it blends. A level blurs as GGX's lobe (Walter et al. 2007) does whose width, at half its
height, is that of the level's texels: 147 degrees times alpha, for lobes that are not wide. So

    alpha = 2^(LEVELS b) (90 degrees / R) / (147 degrees)

with R texels along a face's side. With 32 a mirror has 0.019, which its own texel blurs, and a blur of 1 has 0.31.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.cubemap import box_mips
from polarguide.shading.model import GBuffer

LEVELS = 4
"""Mip levels from a mirror to a blur of 1."""
LOBE_WIDTH = 147.0
"""Degrees of GGX's lobe at half its height, over its alpha."""


def light_levels(radiance: Tensor) -> list[Tensor]:
    """Levels of radiance from afar [6, R, R, 3], from a mirror's to that of a blur of 1."""
    return box_mips(radiance)[: LEVELS + 1]


def ggx_alpha(blur: Tensor, resolution: int) -> Tensor:
    """GGX's alpha of a blur in [0, 1], with so many texels along a face's side."""
    return torch.exp2(LEVELS * blur) * (90 / resolution / LOBE_WIDTH)


def gltf_roughness(blur: Tensor, resolution: int) -> Tensor:
    """Roughness as in glTF, the square root of GGX's alpha, of a blur in [0, 1]; without a gradient."""
    return ggx_alpha(blur.detach(), resolution).sqrt()


def blended_blur(splatted: GBuffer) -> Tensor | None:
    """Blur [H, W], blended over the Gaussians of each pixel; 0 for a mirror, and for a pixel without Gaussians.

    None if the shading model has no blur.
    """
    if "blur" not in splatted.layout:
        return None
    return splatted["blur"][..., 0] / splatted.alpha.detach().clamp(min=1e-6)
