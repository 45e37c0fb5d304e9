"""The PLY of a run: display values that ordinary 3DGS viewers show right, and our linear fields beside them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from polarguide.color import srgb_encode
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.ply import refit_sh_to_display, write_ply
from polarguide.shading.model import Light, Parameters, ShadingModel
from polarguide.training.state import TrainingState


@torch.no_grad()
def gaussian_colors(gaussians: Parameters, light: Light, shading: ShadingModel, directions: Tensor) -> Tensor:
    """Linear colors of every Gaussian toward viewing directions, reflections included.

    Args:
        gaussians: the Gaussians. light: learned, by name. shading: of the recipe.
        directions: [K, 3] unit, from the camera to the Gaussian.

    Returns:
        [N, K, 3]. Each Gaussian is shaded at its own normal, as far as a splat can carry a reflection.
    """
    return torch.stack(_toward(gaussians, light, shading, directions), dim=1)


@torch.no_grad()
def shown_colors(state: TrainingState, shading: ShadingModel, directions: Tensor) -> Tensor:
    """``gaussian_colors`` of a training for display, [N, K, 3] in [0, 1]."""
    linear = _toward(state.gaussians, state.light, shading, directions)
    return torch.stack([srgb_encode(color.clamp(0, 1)) for color in linear], dim=1)


def _toward(gaussians: Parameters, light: Light, shading: ShadingModel, directions: Tensor) -> list[Tensor]:
    """``gaussian_colors`` direction by direction: K of [N, 3]."""
    means = gaussians["means"]
    center = means.new_zeros(3)
    normals = shortest_axis_normals(means, gaussians["quaternions"], gaussians["log_scales"], center)
    colors = []
    for direction in directions.to(means.device):
        # A camera far behind each Gaussian sees it along one direction.
        facing = torch.where((normals @ direction)[:, None] > 0, -normals, normals)
        colors.append(shading.colors(gaussians, light, direction.expand(len(means), 3), facing))
    return colors


@torch.no_grad()
def learned_normals(gaussians: Parameters, centers: Tensor | None) -> Tensor:
    """Unit normals of all Gaussians, [N, 3]: their shortest axes, turned toward the nearest camera.

    Args:
        gaussians: the Gaussians.
        centers: [M, 3] of the cameras, or None: then turned away from the middle of the Gaussians.
    """
    means = gaussians["means"].detach().cpu()
    quaternions, log_scales = (gaussians[name].detach().cpu() for name in ("quaternions", "log_scales"))
    normals = shortest_axis_normals(means, quaternions, log_scales, means.new_zeros(3))
    if centers is None:
        side = means - means.median(dim=0).values
    else:
        places = centers.to(means)
        nearest = torch.cat([torch.cdist(part, places).argmin(dim=1) for part in means.split(1 << 16)])
        side = places[nearest] - means
    return torch.where((normals * side).sum(dim=1, keepdim=True) < 0, -normals, normals)


@torch.no_grad()
def write_run_ply(
    path: Path, state: TrainingState, shading: ShadingModel, centers: Tensor | None = None
) -> None:
    """Write the trained Gaussians; see the module's text, and ``learned_normals`` for the centers of the cameras."""
    gaussians = state.gaussians
    dc, rest = refit_sh_to_display(
        lambda directions: shown_colors(state, shading, directions).cpu(), len(gaussians)
    )
    plain = {
        name: gaussians[name].detach().cpu()
        for name in ("means", "log_scales", "quaternions", "opacity_logits")
    }
    plain["quaternions"] = torch.nn.functional.normalize(plain["quaternions"], dim=-1)
    extra = {name: field.detach().cpu() for name, field in shading.fields(gaussians).items()}
    write_ply(path, **plain, sh_dc=dc, sh_rest=rest, normals=learned_normals(gaussians, centers), extra=extra)
