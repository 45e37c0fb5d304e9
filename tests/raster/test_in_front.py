"""Weight in front of a depth, against a loop over Gaussians and against pictures with the far ones left out."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import in_view, posed

from polarguide.raster import Splats, rasterize_reference
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.surface import alpha_in_front

CAMERA = posed(20, 16)


@pytest.fixture
def splats() -> Splats:
    return in_view(CAMERA, 60, 1, seed=4)


def depths(splats: Splats) -> torch.Tensor:
    return (splats.means.double() - CAMERA.center) @ CAMERA.rotation[2]


def exact(splats: Splats, depth: torch.Tensor) -> torch.Tensor:
    """One rendering per pixel, whose only channel is 1 for the Gaussians nearer than the pixel's depth."""
    places, share = depths(splats), torch.zeros(depth.shape)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            near = (places < depth[y, x]).float()[:, None]
            seen = rasterize_reference(splats._replace(features=near), CAMERA)
            share[y, x] = seen.features[y, x, 0] / seen.alpha[y, x].clamp(min=1e-12)
    return share


def test_which_side_of_one_half_is_exact(splats: Splats) -> None:
    generator = torch.Generator().manual_seed(1)
    places = depths(splats)
    low, high = float(places.min()), float(places.max())
    depth = low + (high - low) * torch.rand(CAMERA.height, CAMERA.width, generator=generator)
    true = exact(splats, depth)
    got = alpha_in_front(splats, CAMERA, depth, rasterize_cpu)
    clear = (true - 0.5).abs() > 1e-5
    assert clear.float().mean() > 0.95
    assert 0.1 < (true >= 0.5).float().mean() < 0.9
    assert torch.equal(got[clear] >= 0.5, true[clear] >= 0.5)
    assert float((got - true).abs().mean()) < 0.05, "and the share itself is about right"


def test_it_is_what_is_seen_of_the_near_ones_alone(splats: Splats) -> None:
    places = depths(splats)
    middle = float(places.median()) + 1e-4
    near = Splats(*(t[places < middle] for t in splats))
    whole = rasterize_cpu(splats, CAMERA).alpha
    expected = rasterize_cpu(near, CAMERA).alpha / whole
    got = alpha_in_front(splats, CAMERA, torch.full_like(whole, middle), rasterize_cpu)
    seen = whole > 1e-3
    torch.testing.assert_close(got[seen], expected[seen], atol=2e-3, rtol=0)


def test_the_ends(splats: Splats) -> None:
    size = (CAMERA.height, CAMERA.width)
    seen = rasterize_cpu(splats, CAMERA).alpha > 0
    beyond = alpha_in_front(splats, CAMERA, torch.full(size, 1e3), rasterize_cpu)
    torch.testing.assert_close(beyond, seen.float())
    before = alpha_in_front(splats, CAMERA, torch.full(size, 1e-3), rasterize_cpu)
    assert float(before.max()) < 0.5
    assert float(alpha_in_front(splats, CAMERA, torch.zeros(size), rasterize_cpu).max()) == 0, "not asked for"
    nothing = Splats(*(t[:0] for t in splats))
    assert float(alpha_in_front(nothing, CAMERA, torch.ones(size), rasterize_cpu).max()) == 0
