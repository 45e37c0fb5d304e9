"""Refractive indices of single objects, as the user says them: ``materials/`` and the table in ``scene.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from polarguide._native import MAX_CHANNELS
from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.raster import Rasterize
from polarguide.shading.metal import any_nonzero
from polarguide.shading.model import Parameters
from polarguide.shading.splatting import splats
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.metals.looks import shares
from polarguide.training.metals.words import with_words

# Pixels of a Gaussian in all views from which on what they say counts.
LEAST_SEEN = 0.05


@torch.no_grad()
def index_offsets(
    gaussians: Parameters,
    views: Sequence[View],
    indices: Mapping[int, float],
    refractive_index: float,
    rasterize: Rasterize,
    memory: MemoryBound = UNBOUNDED,
) -> Tensor:
    """What each Gaussian adds to the run's refractive index, [N].

    It is that of the material that most of its pixels in all views have; 0 where these say another one than the table
    lists, or nothing, and of metals.

    Args:
        indices: by the number in ``View.materials``. refractive_index: of the run.
    """
    means = gaussians["means"].detach()
    said = {view.name: numbers_in(view) for view in views}
    numbers = sorted(set().union(*said.values()) & indices.keys())
    weights = means.new_zeros(len(means), 1 + len(numbers))
    for view in memory.between(with_words(views)):
        assert view.materials is not None
        kinds = view.materials.to(means.device)
        here = [number for number in numbers if number in said[view.name]]
        target = torch.stack(((kinds == 1) | (kinds == 2), *(kinds == k for k in here)), dim=-1).float()
        columns = [0, *(1 + numbers.index(number) for number in here)]
        for some, part in zip(_batched(columns), target.split(MAX_CHANNELS, dim=-1), strict=True):
            weights[:, some] += shares(gaussians, view, part.contiguous(), rasterize)
    offsets = means.new_tensor([0.0, *(indices[number] - refractive_index for number in numbers)])
    most, chosen = weights.max(dim=1)
    given = torch.where(most > LEAST_SEEN, offsets[chosen], torch.zeros_like(most))
    metalness = gaussians.get("metalness")
    return given if metalness is None else given * (metalness == 0)


def numbers_in(view: View) -> set[int]:
    """Numbers of the dielectrics with indices of their own that a view says it shows."""
    return set() if view.materials is None else set(view.materials.unique().tolist()) - {0, 1, 2}


def _batched(columns: list[int]) -> list[list[int]]:
    """So many at a time as a rasterizer takes channels."""
    return [columns[k : k + MAX_CHANNELS] for k in range(0, len(columns), MAX_CHANNELS)]


@torch.no_grad()
def index_picture(
    gaussians: Parameters, camera: Camera, rasterize: Rasterize, refractive_index: float
) -> Tensor | None:
    """Refractive indices [H, W] as blended; None where all Gaussians have the run's."""
    offsets = gaussians.get("index_offset")
    if offsets is None or not any_nonzero(offsets):
        return None
    return refractive_index + rasterize(splats(gaussians, offsets[:, None]), camera).features[..., 0]
