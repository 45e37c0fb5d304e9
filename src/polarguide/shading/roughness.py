"""Blur of reflections by mip levels of the environment, and the equivalent roughness for other renderers.

The blur b of a Gaussian, in [0, 1], selects the level ``LEVELS b`` of the box-filtered radiance. A pixel has the mean
blur of its Gaussians. A level blurs like the GGX lobe (Walter et al. 2007) whose full width at half maximum equals the
width of the level's texels. For narrow lobes that width is 147 degrees times alpha, so with R texels along a face's
side

    alpha = 2^(LEVELS b) (90 degrees / R) / (147 degrees)

With R = 32 a mirror has an alpha of 0.019, the blur of its own texel, and a blur of 1 has 0.31.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.shading.cubemap import box_mips

LEVELS = 4
"""Number of mip levels from a mirror to a blur of 1."""
LOBE_WIDTH = 147.0
"""Full width at half maximum of the GGX lobe, in degrees per unit of alpha."""


def light_levels(radiance: Tensor) -> list[Tensor]:
    """Return the mip levels of radiance [6, R, R, 3] from a mirror to a blur of 1."""
    return box_mips(radiance)[: LEVELS + 1]


def ggx_alpha(blur: Tensor, resolution: int) -> Tensor:
    """Return the alpha of GGX that gives a blur in [0, 1], for ``resolution`` texels along the side of a face."""
    return torch.exp2(LEVELS * blur) * (90 / resolution / LOBE_WIDTH)


def gltf_roughness(blur: Tensor, resolution: int) -> Tensor:
    """Return the roughness of glTF that gives a blur in [0, 1], without a gradient.

    It is the square root of the alpha of GGX.
    """
    return ggx_alpha(blur.detach(), resolution).sqrt()
