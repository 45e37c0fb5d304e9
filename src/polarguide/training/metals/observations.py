"""Measurements of each Gaussian in the views, and its labels in ``materials/``.

A pixel contributes to the values of a Gaussian in proportion to the blending weight of this Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics
from polarguide._native import MAX_CHANNELS
from polarguide.capture import View
from polarguide.capture.exposures import nominal
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import any_nonzero
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render, splats
from polarguide.shading.model import Parameters
from polarguide.training.priors import guide_normals
from polarguide.training.recipe import MetalViews

LEAST_PIXELS = 0.3
"""Least sum of a Gaussian's blending weights over all views for which it is measured or labeled."""


class ViewSamples(NamedTuple):
    """Means over the pixels of each of N Gaussians, in each of V views.

    Attributes:
        weight: [V, N] sum of the blending weights of the pixels.
        s0: [V, N, 3] mean S0.
        across: [V, N, 3] mean polarization P across the plane of incidence.
        oblique: [V, N, 3] mean polarization at 45 degrees to that plane.
        noise: [V, N, 3] mean of a combination of the pictures that is zero for any Stokes vector, such as
            ``(I0 + I90 - I45 - I135) / sqrt(2)``. With independent noise on the pictures, its variance is that of S1
            and S2. Three pictures have no such combination. The mean is then that of S0, which exceeds any noise.
        cosine: [V, N] mean cosine of the zenith angle.
        normal: [V, N, 3] mean rendered normal, in world axes.
    """

    weight: Tensor
    s0: Tensor
    across: Tensor
    oblique: Tensor
    noise: Tensor
    cosine: Tensor
    normal: Tensor


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """Return at most ``most`` evenly spread views."""
    return views[:: max(1, -(-len(views) // most))]


def valid_radiance(view: View) -> Tensor:
    """Return the radiance S0 of the valid pixels of a view, [P, 3]."""
    return 2 * view.photograph()[~(view.invalid | view.saturated)]


def shares(gaussians: Parameters, camera: Camera, target: Tensor, rasterize: Rasterize) -> Tensor:
    """Return, for each Gaussian, the sum of a picture [H, W, C] weighted by its blending weights, [N, C]."""
    with torch.no_grad():
        fixed = splats(gaussians)
    features = target.new_zeros(len(fixed.means), target.shape[-1], requires_grad=True)
    with torch.enable_grad():
        total = (rasterize(fixed._replace(features=features), camera).features * target).sum()
        return torch.autograd.grad(total, features)[0]


def stokes_noise(view: View) -> Tensor:
    """Return a sample [H, W, 3] of the noise of S1 and S2 in each pixel, as ``ViewSamples.noise`` describes."""
    known = [place for place, exposure in enumerate(view.exposures) if exposure.known]
    if len(known) < 4:
        return view.stokes()[0]
    angles = nominal([view.exposures[place] for place in known])
    design = 0.5 * torch.cat((torch.ones_like(angles[:, :1]), angles), dim=1)
    variance = torch.linalg.inv(design.T @ design).diagonal()[1:].mean()
    weights = torch.linalg.svd(design).U[:, -1] * variance.sqrt()  # zero for any Stokes vector
    return torch.einsum("k,khwc->hwc", weights.to(view.device, torch.float32), view.intensities()[known])


def view_sums(gaussians: Parameters, view: View, rasterize: Rasterize, least_normal: float) -> Tensor:
    """Return sums [N, 17] over the pixels of each Gaussian in a view, which has to determine the Stokes vector.

    ``samples_of`` converts these sums to means. The columns are 1, S0 (three colors), P (three), the polarization at 45
    degrees (three), the noise (three), the cosine of the zenith, and the normal in world axes (three).
    """
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
    cosine = -dot(guide, rays)[..., None]
    columns = (one, s0, across, oblique, stokes_noise(view), cosine, view.camera.to_world(guide))
    target = torch.cat(columns, dim=-1) * good
    return shares(gaussians, view.camera, target.contiguous(), rasterize)


def samples_of(looks: Sequence[Tensor], which: slice, limits: MetalViews) -> ViewSamples:
    """Convert sums to means for the selected Gaussians; unusable views get weight 0."""
    sums = torch.stack([look[which] for look in looks])
    weight = sums[..., 0]
    means = sums[..., 1:] / weight.clamp(min=1e-6)[..., None]
    cosine = means[..., 12].clamp(0, 1)
    counts = weight > limits.least_share * weight.amax(dim=0)
    counts &= (cosine > limits.cosines[0]) & (cosine < limits.cosines[1])
    return ViewSamples(
        weight=weight * counts,
        s0=means[..., :3],
        across=means[..., 3:6],
        oblique=means[..., 6:9],
        noise=means[..., 9:12],
        cosine=cosine,
        normal=means[..., 13:16],
    )


@torch.no_grad()
def blended(gaussians: Parameters, values: Tensor, camera: Camera, rasterize: Rasterize) -> Tensor:
    """Blend one value per Gaussian [N] to a picture [H, W]."""
    return rasterize(splats(gaussians, values[:, None]), camera).features[..., 0]


def metalness_share(gaussians: Parameters, camera: Camera, rasterize: Rasterize) -> Tensor | None:
    """Return the blended metalness [H, W], or None if no Gaussian is a metal."""
    metalness = gaussians.get("metalness")
    if metalness is None or not any_nonzero(gaussians, "metalness"):
        return None
    return blended(gaussians, metalness, camera, rasterize)


def labeled_views(views: Iterable[View]) -> list[tuple[View, Tensor]]:
    """Return the views with labels of the user, and their labels [H, W]."""
    return [(view, view.materials) for view in views if view.materials is not None]


def label_weights(
    gaussians: Parameters, views: Iterable[View], rasterize: Rasterize, memory: MemoryBound = UNBOUNDED
) -> Tensor:
    """Return the weights [N, 2] of the pixels that the user labels as dielectric and as metal, over all views."""
    means = gaussians["means"].detach()
    labels = means.new_zeros(len(means), 2)
    for view, kinds in memory.between(labeled_views(views)):
        labels += _labels_in(gaussians, view, kinds, rasterize)
    return labels


def contradicted(
    gaussians: Parameters,
    views: Iterable[View],
    rasterize: Rasterize,
    labels: Tensor,
    limits: MetalViews,
    memory: MemoryBound = UNBOUNDED,
) -> dict[str, float]:
    """Find views whose labels other views contradict.

    Args:
        gaussians: the Gaussians.
        views: all views.
        rasterize: rasterizer of the backend.
        labels: [N, 2] result of ``label_weights`` for all views.
        limits: constants of the search.
        memory: returns freed memory to the system.

    Returns:
        The share of contradicted labels by the name of the view, largest share first. It is relative to the labels of
        Gaussians that other views label as well.
    """
    opposed_shares = {}
    for view, kinds in memory.between(labeled_views(views)):
        labels_here = _labels_in(gaussians, view, kinds, rasterize)
        other_labels = (labels - labels_here).clamp(min=0)
        labels_here = labels_here * (other_labels.sum(dim=1, keepdim=True) > LEAST_PIXELS)
        opposed = (labels_here * (other_labels.flip(1) > other_labels)).sum()
        share = float(opposed / labels_here.sum().clamp(min=1e-6))
        if share > limits.contradicted:
            opposed_shares[view.name] = share
    return dict(sorted(opposed_shares.items(), key=lambda item: -item[1]))


def _labels_in(gaussians: Parameters, view: View, kinds: Tensor, rasterize: Rasterize) -> Tensor:
    """Return the weights [N, 2] of the pixels that the user labels as dielectric and as metal in one view."""
    return _labeled(gaussians, view, kinds, [(kinds == 1) | (kinds > 2), kinds == 2], rasterize)


def _labeled(
    gaussians: Parameters, view: View, kinds: Tensor, masks: Sequence[Tensor], rasterize: Rasterize
) -> Tensor:
    """Return the number of pixels of each Gaussian in each of K masks [H, W], as [N, K].

    The number is 0 for Gaussians with less than half of their pixels labeled. The reason is that pixels at the outline
    of a label also show Gaussians behind it and next to it.
    """
    named = kinds > 0
    target = torch.stack((named, torch.ones_like(named), *masks), dim=-1).float()
    target = target.to(gaussians["means"].device)
    parts = [part.contiguous() for part in target.split(MAX_CHANNELS, dim=-1)]
    sums = torch.cat([shares(gaussians, view.camera, part, rasterize) for part in parts], dim=1)
    return sums[:, 2:] * (sums[:, 0] >= 0.5 * sums[:, 1])[:, None]


LEAST_SEEN = 0.05
"""Least sum of a Gaussian's blending weights over all views for which it gets the refractive index of a material."""


@torch.no_grad()
def index_offsets(
    gaussians: Parameters,
    views: Sequence[View],
    indices: Mapping[int, float],
    refractive_index: float,
    rasterize: Rasterize,
    memory: MemoryBound = UNBOUNDED,
) -> Tensor:
    """Return the offset [N] of each Gaussian from the refractive index of the run.

    The offset belongs to the material that most pixels of the Gaussian show in all views. It is 0 for metals, for
    pixels without a material, and for materials that ``indices`` lacks.

    Args:
        gaussians: the Gaussians.
        views: all views.
        indices: refractive indices by the number in ``View.materials``.
        refractive_index: refractive index of the run.
        rasterize: rasterizer of the backend.
        memory: returns freed memory to the system.
    """
    means = gaussians["means"].detach()
    labels = {view.name: numbers_in(view) for view in views}
    numbers = sorted(set().union(*labels.values()) & indices.keys())
    weights = means.new_zeros(len(means), 1 + len(numbers))
    for view, kinds in memory.between(labeled_views(views)):
        local_numbers = [number for number in numbers if number in labels[view.name]]
        columns = [0, *(1 + numbers.index(number) for number in local_numbers)]
        masks = [(kinds == 1) | (kinds == 2), *(kinds == number for number in local_numbers)]
        weights[:, columns] += _labeled(gaussians, view, kinds, masks, rasterize)
    offsets = means.new_tensor([0.0, *(indices[number] - refractive_index for number in numbers)])
    largest, chosen = weights.max(dim=1)
    specified = torch.where(largest > LEAST_SEEN, offsets[chosen], torch.zeros_like(largest))
    metalness = gaussians.get("metalness")
    return specified if metalness is None else specified * (metalness < 1)


def numbers_in(view: View) -> set[int]:
    """Return the material numbers in a view that may have their own refractive index."""
    return set() if view.materials is None else set(view.materials.unique().tolist()) - {0, 1, 2}


@torch.no_grad()
def index_picture(
    gaussians: Parameters, camera: Camera, rasterize: Rasterize, refractive_index: float
) -> Tensor | None:
    """Return the blended refractive indices [H, W], or None if all Gaussians have the index of the run."""
    offsets = gaussians.get("index_offset")
    if offsets is None or not any_nonzero(gaussians, "index_offset"):
        return None
    return refractive_index + blended(gaussians, offsets, camera, rasterize)
