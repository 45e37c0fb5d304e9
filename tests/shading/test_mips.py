"""Mip levels of a cubemap: what filtering keeps, and the look-up between two levels against a plain evaluation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide.shading.cubemap import cubemap_lookup_reference
from polarguide.shading.mips import box_mips, mip_lookup, mip_lookup_at_once

LEVELS = 5  # of resolution 8: 8, 4, 2, 1, and the mean


def texture(dtype: torch.dtype = torch.float64, channels: int = 5) -> Tensor:
    return torch.randn(6, 8, 8, channels, generator=torch.Generator().manual_seed(0), dtype=dtype)


def directions(count: int = 60) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def plainly(levels: list[Tensor], rays: Tensor, level: Tensor) -> Tensor:
    """Every level for every direction, weighted by its distance."""
    stack = torch.stack([cubemap_lookup_reference(t, rays) for t in levels])
    distance = (torch.arange(len(levels)).to(level)[:, None] - level.clamp(0, len(levels) - 1)).abs()
    return ((1 - distance).clamp(min=0)[..., None] * stack).sum(dim=0)


def test_levels_halve_and_end_in_the_mean() -> None:
    levels = box_mips(texture())
    assert [t.shape[1] for t in levels] == [8, 4, 2, 1, 1]
    assert_close(levels[1][2, 3, 0], texture()[2, 6:8, 0:2].mean(dim=(0, 1)))
    assert_close(levels[-1], texture().mean(dim=(0, 1, 2)).expand(6, 1, 1, 5))
    for level in levels:
        assert_close(level.mean(dim=(0, 1, 2)), texture().mean(dim=(0, 1, 2)))


def test_the_smallest_texture_has_itself_and_its_mean() -> None:
    assert [t.shape[1] for t in box_mips(texture()[:, :1, :1])] == [1, 1]


@pytest.mark.parametrize("shape", [(6, 6, 6, 2), (6, 4, 8, 2), (5, 4, 4, 2), (6, 4, 4), (6, 0, 0, 2)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="power of two"):
        box_mips(torch.zeros(shape))


@pytest.mark.parametrize("level", [0.0, 0.7, 2.0, 3.5, 4.0, 9.0, -1.0])
def test_a_constant_texture_stays_constant(level: float) -> None:
    levels = box_mips(torch.full((6, 8, 8, 2), 1.5))
    found = mip_lookup(levels, directions().float(), torch.full((60,), level))
    assert_close(found, torch.full((60, 2), 1.5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_between_levels_as_plainly_evaluated(dtype: torch.dtype) -> None:
    level = torch.linspace(-0.5, LEVELS, 60, dtype=torch.float64)
    level[::7] = level[::7].round()
    exact = plainly(box_mips(texture()), directions(), level)
    found = mip_lookup(box_mips(texture().to(dtype)), directions().to(dtype), level.to(dtype))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    assert_close(found.double(), exact, rtol=0, atol=tolerance)


def test_gradients_against_finite_differences() -> None:
    level = torch.linspace(0.1, LEVELS - 1.1, 12, dtype=torch.float64)
    inputs = (texture(channels=2).requires_grad_(), directions(12).requires_grad_(), level.requires_grad_())
    assert torch.autograd.gradcheck(lambda t, d, m: mip_lookup(box_mips(t), d, m), inputs, fast_mode=True)


def test_the_sharpest_level_still_says_what_blurring_would_change() -> None:
    """At level 0, where every roughness may begin, the gradient is that toward level 1."""
    levels = box_mips(texture())
    level = torch.zeros(60, dtype=torch.float64, requires_grad=True)
    mip_lookup(levels, directions(), level).sum().backward()
    step = mip_lookup(levels, directions(), level + 1) - mip_lookup(levels, directions(), level)
    assert_close(level.grad, step.detach().sum(dim=1))


def test_no_directions() -> None:
    levels = box_mips(texture())
    assert mip_lookup(levels, torch.zeros(0, 3).double(), torch.zeros(0).double()).shape == (0, 5)


@pytest.mark.parametrize("count", [1, LEVELS])
def test_all_at_once_is_level_by_level(count: int) -> None:
    """What devices other than the CPU compute, with its gradients."""
    rays = directions().requires_grad_()
    levels = [t.detach().requires_grad_() for t in box_mips(texture())[:count]]
    level = torch.linspace(-0.5, count + 0.5, len(rays), dtype=torch.float64).requires_grad_()
    inputs = (*levels, rays, level)
    weights = torch.randn(len(rays), 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    expected = mip_lookup(levels, rays, level)
    clamped = level.clamp(0, count - 1)
    lower = clamped.detach().floor().long().clamp(max=max(0, count - 2))
    found = mip_lookup_at_once(levels, rays, lower, clamped - lower)
    assert_close(found, expected)
    pairs = zip(
        torch.autograd.grad((found * weights).sum(), inputs),
        torch.autograd.grad((expected * weights).sum(), inputs),
        strict=True,
    )
    for a, b in pairs:
        assert_close(a, b)
