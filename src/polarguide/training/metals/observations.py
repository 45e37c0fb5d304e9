"""Measurements of each Gaussian by the views, and its labels in ``materials/``.

Pixels count by what the Gaussian has in them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics
from polarguide._native import MAX_CHANNELS
from polarguide.capture import View
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import any_nonzero
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render, splats
from polarguide.shading.model import Parameters
from polarguide.training.priors import guide_normals
from polarguide.training.recipe import MetalViews

# Pixels in all views from which on a Gaussian is measured, or labeled.
LEAST_PIXELS = 0.3


class ViewSamples(NamedTuple):
    """Means over what V views show of each Gaussian: weight [V, N], S0, P, the polarization at 45 degrees to both
    [V, N, 3], cosine of the zenith [V, N].
    """

    weight: Tensor
    s0: Tensor
    across: Tensor
    oblique: Tensor
    cosine: Tensor


def view_sums(
    gaussians: Parameters, views: Iterable[View], rasterize: Rasterize, limits: MetalViews
) -> list[Tensor]:
    """Sums [N, 11] over the pixels of each view; every view has to determine the Stokes vector. ``samples_of`` turns
    them into means.
    """
    return [_look(gaussians, view, rasterize, limits.least_normal) for view in views]


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """At most so many of the views, every second, third or so."""
    return views[:: max(1, -(-len(views) // most))]


def shares(gaussians: Parameters, camera: Camera, target: Tensor, rasterize: Rasterize) -> Tensor:
    """Sums [N, C] over the pixels of a picture [H, W, C], each by what the Gaussian has in it."""
    with torch.no_grad():
        fixed = splats(gaussians)
    features = target.new_zeros(len(fixed.means), target.shape[-1], requires_grad=True)
    with torch.enable_grad():
        (rasterize(fixed._replace(features=features), camera).features * target).sum().backward()
    assert features.grad is not None
    return features.grad


def _look(gaussians: Parameters, view: View, rasterize: Rasterize, least_normal: float) -> Tensor:
    """Sums [N, 11] over a view's pixels: 1, S0, P, the polarization at 45 degrees to it and the cosine."""
    device = gaussians["means"].device
    normal = render(gaussians, view.camera, rasterize, RenderRequest(sh_degree=0)).normal
    view = view.to(device)
    rays = view.camera.rays(device=device)
    guide, reliable = guide_normals(view.camera.to_camera(normal), rays, least_normal)
    s0, s1, s2 = view.stokes()
    x_ref, up_ref = optics.lens_frame(rays)
    x = dot(guide, x_ref)
    y = dot(guide, up_ref)
    sine2 = (x * x + y * y).clamp(min=1e-6)
    cosine2 = ((x * x - y * y) / sine2)[..., None]
    sine = (2 * x * y / sine2)[..., None]
    across = -(s1 * cosine2 + s2 * sine)
    oblique = s2 * cosine2 - s1 * sine
    one = torch.ones_like(x)[..., None]
    good = (reliable & ~(view.invalid | view.saturated))[..., None]
    target = torch.cat((one, s0, across, oblique, -dot(guide, rays)[..., None]), dim=-1) * good
    return shares(gaussians, view.camera, target.contiguous(), rasterize)


def samples_of(looks: Sequence[Tensor], which: slice, limits: MetalViews) -> ViewSamples:
    """Means of the sums of some Gaussians, with the weight of views that count."""
    sums = torch.stack([look[which] for look in looks])
    weight = sums[..., 0]
    means = sums[..., 1:] / weight.clamp(min=1e-6)[..., None]
    cosine = means[..., 9].clamp(0, 1)
    counts = weight > limits.least_share * weight.amax(dim=0)
    counts &= (cosine > limits.cosines[0]) & (cosine < limits.cosines[1])
    return ViewSamples(weight * counts, means[..., :3], means[..., 3:6], means[..., 6:9], cosine)


@torch.no_grad()
def blended(gaussians: Parameters, values: Tensor, camera: Camera, rasterize: Rasterize) -> Tensor:
    """A value of each Gaussian [N] as blended in a view, [H, W]."""
    return rasterize(splats(gaussians, values[:, None]), camera).features[..., 0]


def metalness_share(gaussians: Parameters, camera: Camera, rasterize: Rasterize) -> Tensor | None:
    """Blended metalness [H, W]; None where no Gaussian is a metal, or none can be."""
    metalness = gaussians.get("metalness")
    if metalness is None or not any_nonzero(gaussians, "metalness"):
        return None
    return blended(gaussians, metalness, camera, rasterize)


def labeled_views(views: Iterable[View]) -> list[View]:
    """Those of the views in which the user names materials."""
    return [view for view in views if view.materials is not None]


def label_weights(
    gaussians: Parameters, views: Iterable[View], rasterize: Rasterize, memory: MemoryBound = UNBOUNDED
) -> Tensor:
    """Weight [N, 2] of the pixels that the user calls dielectric and metal, over the views."""
    means = gaussians["means"].detach()
    labels = means.new_zeros(len(means), 2)
    for view in memory.between(labeled_views(views)):
        labels += _labels_in(gaussians, view, rasterize)
    return labels


def contradicted(
    gaussians: Parameters,
    views: Iterable[View],
    rasterize: Rasterize,
    labels: Tensor,
    limits: MetalViews,
    memory: MemoryBound = UNBOUNDED,
) -> dict[str, float]:
    """Views whose words the other views contradict, the most contradicted first, with the share of those words of
    which others say anything.

    Args:
        labels: by all views, as of ``label_weights``.
    """
    views_contradicted = {}
    for view in memory.between(labeled_views(views)):
        own = _labels_in(gaussians, view, rasterize)
        others = (labels - own).clamp(min=0)
        own = own * (others.sum(dim=1, keepdim=True) > LEAST_PIXELS)
        opposed = (own * (others.flip(1) > others)).sum()
        share = float(opposed / own.sum().clamp(min=1e-6))
        if share > limits.contradicted:
            views_contradicted[view.name] = share
    return dict(sorted(views_contradicted.items(), key=lambda item: -item[1]))


def _labels_in(gaussians: Parameters, view: View, rasterize: Rasterize) -> Tensor:
    assert view.materials is not None
    kinds = view.materials.to(gaussians["means"].device)
    return _labeled(gaussians, view, [(kinds == 1) | (kinds > 2), kinds == 2], rasterize)


def _labeled(gaussians: Parameters, view: View, kinds: Sequence[Tensor], rasterize: Rasterize) -> Tensor:
    """Pixels [N, K] of kinds [H, W] bool in a view, where labels cover at least half of what it shows of a Gaussian.

    At the outline of what is labeled, what lies behind and beside it is in the same pixels.
    """
    assert view.materials is not None
    named = view.materials.to(gaussians["means"].device) > 0
    target = torch.stack((named, torch.ones_like(named), *kinds), dim=-1).float()
    parts = [part.contiguous() for part in target.split(MAX_CHANNELS, dim=-1)]
    sums = torch.cat([shares(gaussians, view.camera, part, rasterize) for part in parts], dim=1)
    return sums[:, 2:] * (sums[:, 0] >= 0.5 * sums[:, 1])[:, None]


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
    """Offset of each Gaussian from the run's refractive index, [N].

    It is that of the material that most of its pixels in all views have; 0 where these say another one than the table
    lists, or nothing, and of metals.

    Args:
        indices: by the number in ``View.materials``. refractive_index: refractive index of the run.
    """
    means = gaussians["means"].detach()
    labels = {view.name: numbers_in(view) for view in views}
    numbers = sorted(set().union(*labels.values()) & indices.keys())
    weights = means.new_zeros(len(means), 1 + len(numbers))
    for view in memory.between(labeled_views(views)):
        assert view.materials is not None
        kinds = view.materials.to(means.device)
        here = [number for number in numbers if number in labels[view.name]]
        columns = [0, *(1 + numbers.index(number) for number in here)]
        masks = [(kinds == 1) | (kinds == 2), *(kinds == number for number in here)]
        weights[:, columns] += _labeled(gaussians, view, masks, rasterize)
    offsets = means.new_tensor([0.0, *(indices[number] - refractive_index for number in numbers)])
    most, chosen = weights.max(dim=1)
    specified = torch.where(most > LEAST_SEEN, offsets[chosen], torch.zeros_like(most))
    metalness = gaussians.get("metalness")
    return specified if metalness is None else specified * (metalness < 1)


def numbers_in(view: View) -> set[int]:
    """Numbers of the dielectrics with indices of their own that a view says it shows."""
    return set() if view.materials is None else set(view.materials.unique().tolist()) - {0, 1, 2}


@torch.no_grad()
def index_picture(
    gaussians: Parameters, camera: Camera, rasterize: Rasterize, refractive_index: float
) -> Tensor | None:
    """Refractive indices [H, W] as blended; None where all Gaussians have the run's."""
    offsets = gaussians.get("index_offset")
    if offsets is None or not any_nonzero(gaussians, "index_offset"):
        return None
    return refractive_index + blended(gaussians, offsets, camera, rasterize)
