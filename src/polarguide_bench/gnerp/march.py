"""Rays through a field: sample positions, and their colors and weights (NeuS, Wang et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.geometry.vectors import dot, unit
from polarguide_bench.gnerp.field import Field, Geometry
from polarguide_bench.gnerp.recipe import Sampling

DIFFUSE_SHARE = 0.1
"""Of the probability with which samples are drawn, what is spread evenly over a ray."""
FIRST_SHARPNESS = 16.0
"""Largest sharpness for the first search, so that samples lie before and behind the surface."""
SECOND_SHARPNESS = 64.0
"""Largest sharpness for the second search."""
TRACED = 64
"""Steps of sphere tracing."""
STRIDE = 0.9
"""Share of the distance that a step goes, since the distance is not exact."""
HIT = 0.01
"""Distance that counts as a hit, in the unit of the region."""
BEHIND_SCALE = 8.0
"""Length of the background's way to infinity, in the unit that its density counts in."""


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Samples of N rays, S each.

    Attributes:
        color: shown colors [N, 3] with what lies behind.
        along: [N, S] of each sample along its ray. weights: [N, S] of each in the picture. places: [N, S, 3].
        slopes: [N, S, 3] of the field there. normals: their directions.
    """

    color: Tensor
    along: Tensor
    weights: Tensor
    places: Tensor
    slopes: Tensor
    normals: Tensor

    @property
    def opacity(self) -> Tensor:
        """[N] of the surface."""
        return self.weights.sum(dim=1)

    @property
    def distance(self) -> Tensor:
        """[N] expected along the ray, over the opacity."""
        return (self.weights * self.along).sum(dim=1) / self.opacity.clamp(min=1e-6)

    @property
    def normal(self) -> Tensor:
        """[N, 3] blended, up to length 1."""
        return (self.weights[..., None] * self.normals).sum(dim=1)


def march(
    field: Field,
    origin: Tensor,
    direction: Tensor,
    sampling: Sampling,
    *,
    generator: torch.Generator | None = None,
) -> RaySamples:
    """Look along rays.

    Args:
        field: what is looked at.
        origin, direction: [N, 3] in the field's coordinates, direction of unit length.
        sampling: how many samples.
        generator: moves the samples within their strata; None: they lie in the middle.
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
    geometry: Geometry = field.geometry(flat)
    normals = unit(geometry.slope)
    # The color does not bend normals: grids would paint with bumps.
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
    """Sphere tracing (Hart 1996): where rays first meet the zero set, [N], and whether they do, [N] bool.

    By the field's map at first; the last steps ask the field itself.
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
    """Opacity of sections of a ray with the scaled distances ``s f`` at their ends (NeuS, Eq. 13)."""
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
    """Where the fine samples [N, S] of each ray lie, in order: where the field's map says that it is opaque."""

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
    """Weights of the sections between samples [N, C], with a share for surfaces that the map may have missed."""
    step = (along[:, 1:] - along[:, :-1]).clamp(min=1e-6)
    middle = 0.5 * (distance[:, 1:] + distance[:, :-1])
    half = 0.5 * (distance[:, 1:] - distance[:, :-1]).minimum(torch.zeros_like(step)).maximum(-10 * step)
    alpha = section_opacity((middle - half) * sharpness, (middle + half) * sharpness)
    through = torch.cumprod(1 - alpha, dim=1)
    weight = alpha * torch.cat((torch.ones_like(alpha[:, :1]), through[:, :-1]), dim=1)
    even = step / step.sum(dim=1, keepdim=True)
    return weight + (1 - weight.sum(dim=1, keepdim=True) + DIFFUSE_SHARE) * even


def _strata(rays: int, count: int, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """One number in each of ``count`` equal parts of [0, 1], for each ray: [N, count]."""
    part = torch.arange(count, dtype=like.dtype, device=like.device)
    if generator is None:
        return ((part + 0.5) / count).expand(rays, -1)
    return (part + torch.rand(rays, count, generator=generator).to(like)) / count


def _inverse(edges: Tensor, weight: Tensor, share: Tensor) -> Tensor:
    """Where the integral of a density, constant between edges [N, E], reaches shares [N, C] of its whole."""
    total = torch.cumsum(weight, dim=1)
    total = torch.cat((torch.zeros_like(total[:, :1]), total), dim=1) / total[:, -1:]
    place = torch.searchsorted(total, share.contiguous(), right=True).clamp(1, weight.shape[1])
    low = total.gather(1, place - 1)
    high = total.gather(1, place)
    first = edges.gather(1, place - 1)
    last = edges.gather(1, place)
    return first + (last - first) * ((share - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)


def _sections(along: Tensor, begin: Tensor, end: Tensor, longest: Tensor) -> tuple[Tensor, Tensor]:
    """From each sample [N, S] to where its section begins and ends, halfway to its neighbors but not far."""
    middle = 0.5 * (along[:, 1:] + along[:, :-1])
    before = torch.cat((begin[:, None], middle), dim=1) - along
    after = torch.cat((middle, end[:, None]), dim=1) - along
    return before.maximum(-longest[:, None]), after.minimum(longest[:, None])


def _behind(
    field: Field, origin: Tensor, direction: Tensor, count: int, generator: torch.Generator | None
) -> Tensor:
    """Shown colors [N, 3] of what lies behind the cameras' sphere; the last sample, at infinity, is opaque."""
    radius = field.region.radius
    share = _strata(len(origin), count, origin, generator)
    reach = radius / (1 - share).clamp(min=1e-4)
    middle = -dot(origin, direction)[:, None]
    nearest = dot(origin, origin)[:, None] - middle**2
    along = middle + (reach**2 - nearest).clamp(min=0).sqrt()
    places = origin[:, None] + along[..., None] * direction[:, None]
    density, colors = field.background(field.region.surroundings(places.view(-1, 3)))
    through = torch.exp(-density.view(-1, count)[:, :-1] * (BEHIND_SCALE / count)).cumprod(dim=1)
    through = torch.nn.functional.pad(torch.nn.functional.pad(through, (1, 0), value=1.0), (0, 1))
    weights = through[:, :-1] - through[:, 1:]
    return (weights[..., None] * colors.view(-1, count, 3)).sum(dim=1)
