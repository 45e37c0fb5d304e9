"""Refractive indices of single objects, as the user says them: ``materials/`` and the table in ``scene.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import splats
from polarguide.shading.metal import any_given
from polarguide.shading.model import Parameters
from polarguide.training.metals.looks import shares

# Pixels of a Gaussian in all views from which on what they say counts.
LEAST_SEEN = 0.05


@torch.no_grad()
def index_offsets(
    gaussians: Parameters,
    views: Sequence[View],
    indices: Mapping[int, float],
    refractive_index: float,
    rasterize: Rasterize,
) -> Tensor:
    """What each Gaussian adds to the run's refractive index, [N].

    It is that of the material that most of its pixels in all views have; 0 where these say another one than the table
    lists, or nothing.

    Args:
        indices: by the number in ``View.materials``. refractive_index: of the run.
    """
    means = gaussians["means"].detach()
    numbers = sorted(indices)
    weights = means.new_zeros(len(means), 1 + len(numbers))
    for view in views:
        if view.materials is not None:
            kinds = view.materials.to(means.device)
            others = (kinds == 1) | (kinds == 2)
            target = torch.stack((others, *(kinds == number for number in numbers)), dim=-1).float()
            weights += shares(gaussians, view, target, rasterize)
    offsets = means.new_tensor([0.0, *(indices[number] - refractive_index for number in numbers)])
    most, chosen = weights.max(dim=1)
    return torch.where(most > LEAST_SEEN, offsets[chosen], torch.zeros_like(most))


@torch.no_grad()
def index_picture(
    gaussians: Parameters, camera: Camera, rasterize: Rasterize, refractive_index: float
) -> Tensor | None:
    """Refractive indices [H, W] as blended; None where all Gaussians have the run's."""
    offsets = gaussians.get("index_offset")
    if offsets is None or not any_given(offsets):
        return None
    return refractive_index + rasterize(splats(gaussians, offsets[:, None]), camera).features[..., 0]
