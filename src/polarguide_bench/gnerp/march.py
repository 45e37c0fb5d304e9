"""Rendering of rays through a field by samples with colors and weights (NeuS, Wang et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.geometry.vectors import dot, unit
from polarguide_bench.gnerp.field import Field
from polarguide_bench.gnerp.recipe import Sampling

DIFFUSE_SHARE = 0.1
"""Share of the samples' probability density that is uniform along a ray."""
FIRST_SHARPNESS = 16.0
"""Upper bound of the sharpness in the first search, so that samples lie on both sides of the surface."""
SECOND_SHARPNESS = 64.0
"""Upper bound of the sharpness in the second search."""
TRACED = 64
"""Number of steps of sphere tracing."""
STRIDE = 0.9
"""Ratio of the step length to the distance. It is below 1, because the learned distance is not exact."""
HIT = 0.01
"""Largest distance from the surface at which a ray counts as a hit, in the unit of the region."""
BEHIND_SCALE = 8.0
"""Optical length of the background, from the sphere to infinity."""


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Samples of N rays, with S samples per ray.

    Attributes:
        color: display colors [N, 3] of the rays, with the background.
        along: distances [N, S] along the rays.
        weights: weights [N, S] of the samples in the color of the ray.
        places: coordinates [N, S, 3] of the field.
        slopes: gradients [N, S, 3] of the distance.
        normals: directions [N, S, 3] of the gradients.
    """

    color: Tensor
    along: Tensor
    weights: Tensor
    places: Tensor
    slopes: Tensor
    normals: Tensor

    @property
    def opacity(self) -> Tensor:
        """Opacity [N] of the surface on each ray."""
        return self.weights.sum(dim=1)

    @property
    def distance(self) -> Tensor:
        """Mean distance [N] of the samples along each ray, weighted with their weights."""
        return (self.weights * self.along).sum(dim=1) / self.opacity.clamp(min=1e-6)

    @property
    def normal(self) -> Tensor:
        """Blended normal [N, 3] of each ray, not longer than 1."""
        return (self.weights[..., None] * self.normals).sum(dim=1)


def march(
    field: Field,
    origin: Tensor,
    direction: Tensor,
    sampling: Sampling,
    *,
    generator: torch.Generator | None = None,
) -> RaySamples:
    """Sample a field along rays.

    Args:
        field: the field.
        origin: [N, 3] in coordinates of the field.
        direction: [N, 3], unit length.
        sampling: number of samples.
        generator: source of random positions within the strata. None places samples at the centers of the strata.
    """
    count = len(origin)
    fine = sampling.fine
    with torch.no_grad():
        begin, end = field.region.span(origin, direction)
        along = _samples(field, origin, direction, begin, end, sampling, generator)
        before, after = _sections(along, begin, end, (end - begin) / sampling.coarse)
    places = origin[:, None] + along[..., None] * direction[:, None]
    flat = places.view(-1, 3)
    rays = direction[:, None].expand(-1, fine, -1).reshape(-1, 3)
    geometry = field.geometry(flat)
    normals = unit(geometry.slope)
    # The color has no gradient with respect to normals. Otherwise grids would explain texture by bumps.
    colors = field.color(flat, rays, normals.detach(), geometry.features).view(count, fine, 3)
    falling = dot(rays, geometry.slope).view(count, fine).clamp(max=0)
    distance = geometry.distance.view(count, fine)
    first, last = ((distance + falling * step) * field.sharpness for step in (before, after))
    alpha = section_opacity(first, last)
    through = torch.cumprod(1 - alpha + 1e-7, dim=1)
    weights = alpha * torch.cat((torch.ones_like(through[:, :1]), through[:, :-1]), dim=1)
    color = (weights[..., None] * colors).sum(dim=1)
    color = color + through[:, -1:] * _behind(field, origin, direction, sampling.background, generator)
    shape = (count, fine, 3)
    return RaySamples(color, along, weights, places, geometry.slope.view(shape), normals.view(shape))


def trace(field: Field, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Find the first intersections of rays with the surface by sphere tracing (Hart 1996).

    The first steps use the coarse map of distances. The last steps use the field itself.

    Returns:
        Distances [N] along the rays, and a mask [N] of the rays that hit the surface.
    """
    begin, end = field.region.span(origin, direction)
    along = begin
    for step in range(TRACED):
        places = origin + along[:, None] * direction
        exact = step >= TRACED - 3
        distance = field.geometry(places).distance if exact else field.near_distance(places)
        along = along + (distance if exact else STRIDE * distance)
    hit = (distance.abs() < HIT) & (along > begin) & (along < end)
    return along.minimum(end).maximum(begin), hit


def section_opacity(first: Tensor, last: Tensor) -> Tensor:
    """Return the opacity of sections of a ray from ``s f`` (sharpness times distance) at both ends (NeuS, Eq. 13)."""
    entering = torch.sigmoid(first)
    leaving = torch.sigmoid(last)
    return ((entering - leaving) / (entering + 1e-5)).clamp(0, 1)


def _samples(
    field: Field,
    origin: Tensor,
    direction: Tensor,
    begin: Tensor,
    end: Tensor,
    sampling: Sampling,
    generator: torch.Generator | None,
) -> Tensor:
    """Return sorted positions [N, S] of the fine samples, which are denser where the coarse map is opaque."""

    def near(along: Tensor) -> Tensor:
        return field.near_distance(origin[:, None] + along[..., None] * direction[:, None])

    def draw(along: Tensor, distance: Tensor, count: int, sharpness: float) -> Tensor:
        weight = _map_weights(along, distance, sharpness)
        return _inverse(along, weight, _strata(len(origin), count, origin, generator))

    sharpness = float(field.sharpness.detach())
    along = begin[:, None] + (end - begin)[:, None] * _strata(len(origin), sampling.coarse, origin, generator)
    distance = near(along)
    more = draw(along, distance, sampling.coarse, min(FIRST_SHARPNESS, sharpness))
    along, order = torch.cat((along, more), dim=1).sort(dim=1)
    distance = torch.cat((distance, near(more)), dim=1).gather(1, order)
    return draw(along, distance, sampling.fine, min(SECOND_SHARPNESS, sharpness))


def _map_weights(along: Tensor, distance: Tensor, sharpness: float) -> Tensor:
    """Return weights of the sections between samples [N, C].

    A share of the weight is uniform, for surfaces that the coarse map does not contain.
    """
    step = (along[:, 1:] - along[:, :-1]).clamp(min=1e-6)
    middle = 0.5 * (distance[:, 1:] + distance[:, :-1])
    half = 0.5 * (distance[:, 1:] - distance[:, :-1]).minimum(torch.zeros_like(step)).maximum(-10 * step)
    alpha = section_opacity((middle - half) * sharpness, (middle + half) * sharpness)
    through = torch.cumprod(1 - alpha, dim=1)
    weight = alpha * torch.cat((torch.ones_like(alpha[:, :1]), through[:, :-1]), dim=1)
    even = step / step.sum(dim=1, keepdim=True)
    return weight + (1 - weight.sum(dim=1, keepdim=True) + DIFFUSE_SHARE) * even


def _strata(rays: int, count: int, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return numbers [N, count], one in each of ``count`` equal parts of [0, 1], for each ray."""
    part = torch.arange(count, dtype=like.dtype, device=like.device)
    if generator is None:
        return ((part + 0.5) / count).expand(rays, -1)
    return (part + torch.rand(rays, count, generator=generator).to(like)) / count


def _inverse(edges: Tensor, weight: Tensor, share: Tensor) -> Tensor:
    """Return positions at which the integral of a density reaches shares [N, C] of its total.

    The density is constant between edges [N, E].
    """
    total = torch.cumsum(weight, dim=1)
    total = torch.cat((torch.zeros_like(total[:, :1]), total), dim=1) / total[:, -1:]
    place = torch.searchsorted(total, share.contiguous(), right=True).clamp(1, weight.shape[1])
    low, first = (values.gather(1, place - 1) for values in (total, edges))
    high, last = (values.gather(1, place) for values in (total, edges))
    return first + (last - first) * ((share - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)


def _sections(along: Tensor, begin: Tensor, end: Tensor, longest: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offsets from each sample [N, S] to both ends of its section.

    The ends are halfway to the neighboring samples, but not farther than ``longest`` allows.
    """
    middle = 0.5 * (along[:, 1:] + along[:, :-1])
    before = torch.cat((begin[:, None], middle), dim=1) - along
    after = torch.cat((middle, end[:, None]), dim=1) - along
    return before.maximum(-longest[:, None]), after.minimum(longest[:, None])


def _behind(
    field: Field, origin: Tensor, direction: Tensor, count: int, generator: torch.Generator | None
) -> Tensor:
    """Render display colors [N, 3] of the background outside the sphere of the cameras. The last sample is opaque."""
    share = _strata(len(origin), count, origin, generator)
    reach = field.region.radius / (1 - share).clamp(min=1e-4)
    middle = -dot(origin, direction)[:, None]
    nearest = dot(origin, origin)[:, None] - middle**2
    along = middle + (reach**2 - nearest).clamp(min=0).sqrt()
    places = origin[:, None] + along[..., None] * direction[:, None]
    density, colors = field.background(field.region.surroundings(places.view(-1, 3)))
    through = torch.exp(-density.view(-1, count)[:, :-1] * (BEHIND_SCALE / count)).cumprod(dim=1)
    through = pad(pad(through, (1, 0), value=1.0), (0, 1))
    weights = through[:, :-1] - through[:, 1:]
    return (weights[..., None] * colors.view(-1, count, 3)).sum(dim=1)
