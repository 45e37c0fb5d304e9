"""The learned light of a run as plain numbers for the page's textures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from polarguide.shading.cubemap import ringed_texels
from polarguide.shading.mips import box_mips


@torch.no_grad()
def light_numbers(levels: Sequence[Tensor]) -> NDArray[np.float16]:
    """Cubemaps [6, R, R, C] with their rings, one after the other, channels filled up to a multiple of four."""
    rows = []
    for texture in levels:
        texels = ringed_texels(texture.detach().clamp(-6e4, 6e4))
        rows.append(pad(texels, (0, -texels.shape[-1] % 4)).flatten())
    return torch.cat(rows).numpy().astype("<f2")


@torch.no_grad()
def directional_levels(light: Mapping[str, Tensor]) -> list[Tensor]:
    """The levels of the directional shading's grid."""
    return box_mips(light["texels"])


@torch.no_grad()
def network_numbers(light: Mapping[str, Tensor]) -> NDArray[np.float32]:
    """The MLP: for each layer weights [inputs, outputs], then biases; outputs filled up to a multiple of four."""
    rows = []
    for layer in range(3):
        for values in (light[f"mlp_weight_{layer}"].detach(), light[f"mlp_bias_{layer}"].detach()[None]):
            rows.append(pad(values, (0, -values.shape[1] % 4)).flatten())
    return torch.cat(rows).numpy().astype("<f4")


def viridis() -> NDArray[np.uint8]:
    """The color map of scalar layers, [256, 3] RGB."""
    colors = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(colors[0, :, ::-1], dtype=np.uint8)
