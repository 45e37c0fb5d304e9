"""The PLY of a run: display values that ordinary 3DGS viewers show right, and our linear fields beside them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.ply import refit_sh_to_display, write_ply
from polarguide.gaussians.spherical_harmonics import evaluate_sh
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.display import srgb_encode
from polarguide.shading.render import Shading, local_light, mirrored
from polarguide.training.run import atomic
from polarguide.training.state import TrainingState


@torch.no_grad()
def shown_colours(state: TrainingState, shading: Shading, directions: Tensor) -> Tensor:
    """Display colours of every Gaussian towards viewing directions, reflections included.

    Args:
        state: of a training. shading: of its recipe. directions: [K, 3] unit, from the camera to the Gaussian.

    Returns:
        [N, K, 3] in [0, 1]. Reflection is shaded per Gaussian at its own normal, as far as a splat can carry it.
    """
    rows = state.rows
    columns = []
    normals = shortest_axis_normals(rows["means"], rows["quaternions"], rows["log_scales"], torch.zeros(3))
    for direction in directions:
        # A camera far behind each Gaussian sees it along one direction.
        means = direction.expand(len(rows), 3)
        colour = (evaluate_sh(means, torch.zeros(3), rows["sh_dc"], rows["sh_rest"], 3) + 0.5).clamp(min=0)
        if state.environment is not None:
            facing = torch.where((normals @ direction)[:, None] > 0, -normals, normals)
            light = shading.light(
                cubemap_lookup(state.environment.texels, mirrored(means, facing).contiguous())
            )
            if shading.local:
                own = local_light(rows, facing, means, 3)
                light = (light + own).clamp(min=0)
            strength = torch.sigmoid(rows["strength_logits"])[:, None]
            cosine = -(means * facing).sum(dim=-1, keepdim=True).clamp(-1, 0)
            specular, diffuse = shading.layers(colour, strength, light, cosine)
            colour = specular + diffuse
        columns.append(srgb_encode(colour.clamp(0, 1)))
    return torch.stack(columns, dim=1)


@torch.no_grad()
def write_run_ply(path: Path, state: TrainingState, shading: Shading) -> None:
    """Write the trained Gaussians; see the module's text."""
    rows = state.rows
    dc, rest = refit_sh_to_display(lambda directions: shown_colours(state, shading, directions), len(rows))
    extra = {"linear_dc": rows["sh_dc"].detach(), "linear_rest": rows["sh_rest"].detach().flatten(1)}
    if "strength_logits" in rows:
        extra["strength"] = torch.sigmoid(rows["strength_logits"]).detach()
    with atomic(path) as temporary:
        write_ply(
            temporary,
            means=rows["means"].detach(),
            log_scales=rows["log_scales"].detach(),
            quaternions=torch.nn.functional.normalize(rows["quaternions"].detach(), dim=-1),
            opacity_logits=rows["opacity_logits"].detach(),
            sh_dc=dc,
            sh_rest=rest,
            extra=extra,
        )
