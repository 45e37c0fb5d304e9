"""From where each Gaussian is seen: the side of a surface that is outside."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.raster import Rasterise
from polarguide.shading.render import Rows, render
from polarguide.vectors import unit

# A Gaussian at most this much behind the rendered surface, relative to its depth, is seen.
DEPTH_SLACK = 0.02


@torch.no_grad()
def outward_directions(rows: Rows, views: Iterable[View], rasterise: Rasterise) -> Tensor:
    """Sum of the unit directions to the cameras that see each Gaussian.

    A camera sees it where its centre lies in the picture and not behind the rendered depth.

    Args:
        rows: the Gaussians. views: whose cameras look. rasterise: of the backend.

    Returns:
        [N, 3]; zero where no camera sees it.
    """
    means = rows["means"]
    total = torch.zeros_like(means)
    for view in views:
        camera = view.camera
        depth = render(rows, camera, rasterise, sh_degree=0, normals=False, depth=True).depth
        assert depth is not None
        centre = camera.pose(means.dtype, means.device).centre
        x, y, z = camera.to_camera(means - centre).unbind(-1)
        safe = z.clamp(min=1e-6)
        column = (camera.fx * x / safe + camera.cx).floor().clamp(-1, camera.width).long()
        row = (camera.fy * y / safe + camera.cy).floor().clamp(-1, camera.height).long()
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        surface = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
        seen = inside & (z < surface * (1 + DEPTH_SLACK))
        total += seen[:, None] * unit(centre - means)
    return total
