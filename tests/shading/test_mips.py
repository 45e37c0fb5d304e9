"""Mip levels of a cubemap: what filtering keeps, and the look-up between two levels against a plain evaluation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.shading.cubemap import box_mips, cubemap_lookup_reference, mip_lookup, mip_lookup_reference

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


@pytest.mark.parametrize("count", [1, 2, LEVELS])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_the_native_look_up_is_the_reference(count: int, channels: int) -> None:
    rays = directions(200)
    rays[:8] = torch.tensor([[s, t, 1.0] for s in (-1, 1) for t in (-1, 0.99, 1, 0)])  # at edges and corners
    # Not at whole levels, where the gradient by the level jumps.
    level = torch.linspace(-0.55, count + 0.55, len(rays), dtype=torch.float64)
    weights = torch.randn(
        len(rays), channels, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    found = []
    for look_up, dtype in ((mip_lookup, torch.float32), (mip_lookup_reference, torch.float64)):
        levels = [t.to(dtype).requires_grad_() for t in box_mips(texture(channels=channels).detach())[:count]]
        inputs = (*levels, rays.to(dtype).requires_grad_(), level.to(dtype).requires_grad_())
        seen = look_up(levels, *inputs[count:])
        gradients = torch.autograd.grad((seen * weights.to(dtype)).sum(), inputs, allow_unused=count == 1)
        found.append([t.detach().double() for t in (seen, *gradients) if t is not None])
    if count == 1:  # a single level has no gradient by the level
        found = [of[:3] for of in found]
    for ours, exact in zip(*found, strict=True):
        assert_close(ours, exact, rtol=1e-3, atol=1e-4)


def test_threads_do_not_change_a_bit() -> None:
    found = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        levels = [t.float().requires_grad_() for t in box_mips(texture())]
        rays, level = (
            directions(9000).float().requires_grad_(),
            4 * torch.rand(9000, generator=torch.Generator().manual_seed(4)),
        )
        seen = mip_lookup(levels, rays, level)
        found.append([seen.detach(), *torch.autograd.grad(seen.square().sum(), [*levels, rays])])
    _native.set_thread_count(0)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_a_texture_of_many_channels_goes_by_the_reference() -> None:
    levels = box_mips(texture(torch.float32, channels=65))
    level = torch.linspace(0, 4, 60)
    found = mip_lookup(levels, directions().float(), level)
    assert_close(found, mip_lookup_reference(levels, directions().float(), level))
