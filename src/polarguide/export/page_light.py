"""The learned light of a run as plain numbers for the page's textures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from polarguide.shading.cubemap import ringed_texels


@torch.no_grad()
def light_numbers(levels: Sequence[Tensor]) -> NDArray[np.float16]:
    """Cubemaps [6, R, R, C] with their rings, one after the other, channels filled up to a multiple of four."""
    numbers = []
    for texture in levels:
        texels = ringed_texels(texture.detach().clamp(-6e4, 6e4))
        numbers.append(pad(texels, (0, -texels.shape[-1] % 4)).flatten())
    return torch.cat(numbers).numpy().astype("<f2")


@torch.no_grad()
def network_numbers(matrices: Sequence[Tensor]) -> NDArray[np.float32]:
    """Matrices [rows, columns] one after the other, columns filled up to a multiple of four."""
    padded = [pad(matrix.detach(), (0, -matrix.shape[1] % 4)).flatten() for matrix in matrices]
    return torch.cat(padded).numpy().astype("<f4")


def viridis() -> NDArray[np.uint8]:
    """The color map of scalar layers, [256, 3] RGB."""
    colors = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(colors[0, :, ::-1], dtype=np.uint8)
