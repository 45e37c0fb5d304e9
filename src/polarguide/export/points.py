"""The Gaussians on a scene's surfaces as a plain point cloud with normals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from polarguide.capture import View
from polarguide.color import srgb_encode
from polarguide.errors import PolarguideError
from polarguide.files import atomic
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster import Rasterize
from polarguide.shading.model import Parameters, ShadingModel
from polarguide.training.actions import outward_directions

OPAQUE = 0.5
FIELDS = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    (name, "u1") for name in ("red", "green", "blue")
]


@torch.no_grad()
def surface_points(
    gaussians: Parameters, shading: ShadingModel, views: Iterable[View], rasterize: Rasterize
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, outward unit normals and display colors, each [M, 3], of opaque Gaussians that a view sees.

    Raises:
        PolarguideError: there are none.
    """
    outward = outward_directions(gaussians, views, rasterize)
    opaque = torch.sigmoid(gaussians["opacity_logits"]) >= OPAQUE
    kept = (opaque & (outward.norm(dim=1) > 0)).nonzero()[:, 0]
    if not len(kept):
        raise PolarguideError(
            "--format points",
            expected="opaque Gaussians that a view sees",
            found="none",
            remedy="Train for more steps.",
        )
    means, side = gaussians["means"][kept], outward[kept]
    normals = shortest_axis_normals(
        means, gaussians["quaternions"][kept], gaussians["log_scales"][kept], torch.zeros(3)
    )
    normals = torch.where((normals * side).sum(dim=1, keepdim=True) < 0, -normals, normals)
    few = {name: gaussians[name][kept] for name in (*CORE_SHAPES, *shading.parameters)}
    linear = shading.diffuse_colors(few, -normals.contiguous())
    colors = srgb_encode(linear.clamp(0, 1))
    return means, normals, colors


def write_points(
    path: Path, points: Tensor, normals: Tensor, colors: Tensor, comments: Sequence[str] = ()
) -> None:
    """Write a PLY of points, with comments."""
    table = np.empty(len(points), dtype=FIELDS)
    values = np.concatenate((points.numpy(), normals.numpy()), axis=1)
    for index, (name, _) in enumerate(FIELDS[:6]):
        table[name] = values[:, index]
    shades = np.rint(colors.numpy() * 255).astype(np.uint8)
    for index, name in enumerate(("red", "green", "blue")):
        table[name] = shades[:, index]
    with atomic(path) as temporary:
        element = PlyElement.describe(table, "vertex", comments=list(comments))
        PlyData([element], byte_order="<").write(temporary)
