"""Rays through a field that starts as a sphere: where they meet it, and their weights against a loop."""

from __future__ import annotations

import math

import pytest
import torch
from small_fields import SMALL_SAMPLING, SMALL_SHAPE

from polarguide.fields.field import Field, GridField, NetworkField, Region
from polarguide.fields.march import march, section_opacity, trace
from polarguide.fields.recipe import FieldShape, Sampling

REGION = Region((0.0, 0.0, 0.0), 1.0, 2.5)
RADIUS = 0.5 * REGION.radius
FINE = Sampling(coarse=64, fine=64, background=4)


def grid_field(spread: float = 0.01) -> Field:
    shape = FieldShape(resolutions=(8, 16), channels=2, width=16, background=(8,), first_spread=spread)
    return GridField(REGION, shape, torch.Generator().manual_seed(3))


def rays(offsets: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays along z that pass the origin at these distances."""
    origin = torch.stack((offsets, torch.zeros_like(offsets), torch.full_like(offsets, -2.4)), dim=1)
    return origin, torch.tensor([0.0, 0, 1]).expand(len(offsets), 3)


def test_rays_meet_the_sphere_where_it_is() -> None:
    offsets = torch.tensor([0.0, 0.5, 1.0])
    origin, direction = rays(offsets)
    wanted = 2.4 - (RADIUS**2 - offsets**2).sqrt()
    with torch.no_grad():
        seen = march(grid_field(), origin, direction, FINE)
        traced, hit = trace(grid_field(), origin, direction)
    assert bool(hit.all())
    torch.testing.assert_close(traced, wanted, atol=2e-3, rtol=0)
    torch.testing.assert_close(seen.distance, wanted, atol=0.03, rtol=0)
    assert float(seen.opacity.min()) > 0.99
    normal = (origin + wanted[:, None] * direction) / RADIUS
    torch.testing.assert_close(seen.normal, normal, atol=0.05, rtol=0)


def test_rays_beside_it_see_what_lies_behind() -> None:
    origin, direction = rays(torch.tensor([1.6, 2.2]))
    with torch.no_grad():
        seen = march(grid_field(), origin, direction, FINE)
        _, hit = trace(grid_field(), origin, direction)
        alone = march(grid_field(), origin, direction, FINE, kept=lambda places: places[:, 0] > -9)
    assert not bool(hit.any())
    assert float(seen.opacity.max()) < 1e-3
    assert float(seen.color.min()) > 0.1
    assert float(alone.color.max()) < 1e-3, "nothing lies behind what is cropped"


def test_what_is_cropped_is_not_seen() -> None:
    origin, direction = rays(torch.tensor([0.0]))
    with torch.no_grad():
        seen = march(grid_field(), origin, direction, FINE, kept=lambda places: places[:, 2] > 2)
    assert float(seen.opacity) < 1e-3


def test_weights_against_a_loop() -> None:
    """Sections end halfway between samples; opacity is the drop of the logistic function of s f over a section."""
    field = grid_field(0.05)
    origin, direction = rays(torch.tensor([0.3, 1.2]))
    with torch.no_grad():
        seen = march(field, origin, direction, SMALL_SAMPLING)
    s, longest = float(field.sharpness.detach()), 1e9
    for n in range(2):
        begin, end = (float(t[n]) for t in REGION.span(origin, direction))
        longest = (end - begin) / SMALL_SAMPLING.coarse
        along = seen.along[n].tolist()
        through = 1.0
        for k, at in enumerate(along):
            place = origin[n] + at * direction[n]
            distance = float(place.norm()) - RADIUS
            falling = min(0.0, float(direction[n] @ place / place.norm()))
            before = (along[k - 1] + at) / 2 if k else begin
            after = (along[k + 1] + at) / 2 if k + 1 < len(along) else end
            first = 1 / (1 + math.exp(-s * (distance + falling * max(before - at, -longest))))
            last = 1 / (1 + math.exp(-s * (distance + falling * min(after - at, longest))))
            alpha = max(0.0, (first - last) / (first + 1e-5))
            assert float(seen.weights[n, k]) == pytest.approx(through * alpha, abs=1e-4)
            through *= 1 - alpha


def test_opacity_of_a_section() -> None:
    entering, leaving = torch.tensor([5.0, -5.0, 0.0]), torch.tensor([-5.0, 5.0, 0.0])
    found = section_opacity(entering, leaving)
    torch.testing.assert_close(found, torch.tensor([0.9932, 0.0, 0.0]), atol=1e-3, rtol=0)


def test_the_map_has_the_distances() -> None:
    field = grid_field()
    with torch.no_grad():
        for table in field.shape_grids.levels:  # type: ignore[union-attr]
            table.copy_(0.05 * torch.randn(table.shape, generator=torch.Generator().manual_seed(4)))
        field.map_distances()
        places = 2.4 * (2 * torch.rand(200, 3) - 1)
        exact = field.geometry(places).distance
        torch.testing.assert_close(field.near_distance(places), exact, atol=0.02, rtol=0)
        axes = tuple(torch.linspace(-2, 2, n) for n in (3, 4, 5))
        lattice = field.lattice(axes)
        corner = torch.stack([axis[-1] for axis in axes])[None]
        assert float(lattice[-1, -1, -1]) == pytest.approx(float(field.geometry(corner).distance), abs=1e-5)


def test_the_published_networks_start_as_the_sphere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NetworkField, "map_side", 5)
    field = NetworkField(REGION, FieldShape(kind="networks"), torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(6)
    outward = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=1)
    places = 2 * outward * torch.rand(400, 1, generator=generator)
    seen = field.geometry(places)
    error = (seen.distance.detach() - (places.norm(dim=1) - RADIUS)).abs()
    assert float(error.mean()) < 0.35  # of a radius of 1.25; the initialization holds on the average alone
    cosine = torch.nn.functional.cosine_similarity(seen.slope.detach(), places)
    assert float(cosine.median()) > 0.95
    color = field.color(places, places, seen.slope, seen.features)
    (color.mean() + seen.slope.norm(dim=1).mean()).backward()
    gradient = field.layers[0].weight.grad
    assert gradient is not None
    assert bool(gradient.isfinite().all())
    assert float(gradient.abs().max()) > 0


def test_a_shape_of_its_own_is_kept_small() -> None:
    assert (
        sum(values.numel() for values in GridField(REGION, SMALL_SHAPE, torch.Generator()).parameters())
        < 30_000
    )
