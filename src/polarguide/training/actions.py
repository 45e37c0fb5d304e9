"""What recipes can make happen between steps: resets and the normal propagation of 3DGS-DR."""

from __future__ import annotations

import torch

from polarguide.shading.model import ShadingModel
from polarguide.training.recipe import Propagation
from polarguide.training.state import TrainingState


def _logit(value: float) -> float:
    return float(torch.logit(torch.tensor(value, dtype=torch.float64)))


@torch.no_grad()
def reset_opacity(state: TrainingState, shading: ShadingModel, most: float) -> None:
    """Lower opacities to ``most``, so that what is not needed stays transparent (Kerbl et al. 2023).

    Parameters of the shading model rise to their minimum after a reset, where they have one.
    """
    gaussians = state.gaussians
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(max=_logit(most)))
    for name, parameter in shading.parameters.items():
        if parameter.reset_minimum is not None:
            gaussians.overwrite(name, gaussians[name].clamp(min=parameter.reset_minimum))


@torch.no_grad()
def propagate_normals(
    state: TrainingState,
    shading: ShadingModel,
    settings: Propagation,
    generator: torch.Generator,
    steps: int,
) -> None:
    """Let Gaussians with a right normal take over their neighborhood (Ye et al. 2024, Sec. 3.3).

    Opacities rise, matte Gaussians get noise on their color (which hides what they explain by color alone), and
    glossy ones grow along their surface.
    """
    gaussians = state.gaussians
    strength = shading.strength(gaussians)
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(min=_logit(settings.opacity)))
    # Drawn on the CPU, so that every device gets the same noise.
    noise = (torch.rand(gaussians["sh_dc"].shape, generator=generator) * 2 - 1) * settings.color_noise
    noise = noise.to(gaussians["sh_dc"].device)
    matte = (strength <= settings.matte)[:, None]
    # The release adds the noise to the SH coefficient itself; so do we.
    gaussians.overwrite("sh_dc", gaussians["sh_dc"] + torch.where(matte, noise, torch.zeros_like(noise)))
    scales = gaussians["log_scales"]
    longer = torch.ones_like(scales).scatter(1, scales.argmin(dim=1, keepdim=True), 0.0)
    grow = (strength >= settings.glossy)[:, None] * longer * torch.log(torch.tensor(settings.widen))
    gaussians.overwrite("log_scales", scales + grow)
    state.opacity_frozen_until = state.step + min(settings.rest, steps // settings.rest_part)
