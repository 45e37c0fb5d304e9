"""What the user says of materials: ``materials/`` of the scene, by Gaussian."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.raster import Rasterize
from polarguide.shading.model import Parameters
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.metals.looks import shares
from polarguide.training.metals.rules import MetalRules


def with_words(views: Iterable[View]) -> list[View]:
    """Those of the views in which the user names materials."""
    return [view for view in views if view.materials is not None]


def said_by(
    gaussians: Parameters, views: Iterable[View], rasterize: Rasterize, memory: MemoryBound = UNBOUNDED
) -> Tensor:
    """Weight [N, 2] of the pixels that the user calls dielectric and metal, over the views."""
    means = gaussians["means"].detach()
    said = means.new_zeros(len(means), 2)
    for view in memory.between(with_words(views)):
        said += _said_in(gaussians, view, rasterize)
    return said


def contradicted(
    gaussians: Parameters,
    views: Iterable[View],
    rasterize: Rasterize,
    said: Tensor,
    rules: MetalRules,
    memory: MemoryBound = UNBOUNDED,
) -> dict[str, float]:
    """Views whose words the other views contradict, the most contradicted first, with the share of those words of
    which others say anything.

    Args:
        said: by all views, as of ``said_by``.
    """
    found = {}
    for view in memory.between(with_words(views)):
        own = _said_in(gaussians, view, rasterize)
        others = (said - own).clamp(min=0)
        own = own * (others.sum(dim=1, keepdim=True) > rules.least_weight)
        opposed = (own * (others.flip(1) > others)).sum()
        share = float(opposed / own.sum().clamp(min=1e-6))
        if share > rules.contradicted:
            found[view.name] = share
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _said_in(gaussians: Parameters, view: View, rasterize: Rasterize) -> Tensor:
    assert view.materials is not None
    kinds = view.materials.to(gaussians["means"].device)
    target = torch.stack(((kinds == 1) | (kinds > 2), kinds == 2), dim=-1).float()
    return shares(gaussians, view, target, rasterize)
