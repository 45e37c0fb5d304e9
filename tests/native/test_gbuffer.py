"""Normal and depth of a G-buffer: the native pass against the slices, value and gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.shading.gbuffer import split, split_reference
from polarguide.shading.native import split_native
from polarguide.shading.result import Layout

HEIGHT, WIDTH, CHANNELS = 40, 61, 11
SIZE = (HEIGHT, WIDTH)


def layout(*, depth: bool) -> Layout:
    return Layout({"color": 3, "normal": 3, "own": CHANNELS - 6 - depth, **({"depth": 1} if depth else {})})


def buffers(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(*SIZE, CHANNELS, generator=generator)
    alpha = torch.rand(SIZE, generator=generator)
    alpha[3], alpha[4], alpha[5] = 0.0, 1e-7, 2e-6
    return features.to(dtype).requires_grad_(), alpha.to(dtype).requires_grad_()


def with_gradients(function, dtype: torch.dtype, read: str, depth: bool) -> list[Tensor]:
    features, alpha = buffers(dtype)
    given = dict(zip("fnd", function(features, alpha, layout(depth=depth)), strict=True))
    seed = torch.Generator().manual_seed(1)
    total = sum((torch.randn(given[k].shape, generator=seed) * given[k]).sum() for k in read)
    total.backward()
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in (features, alpha)]
    return [t.detach() for t in given.values() if t is not None] + gradients


@pytest.mark.parametrize("read", ["f", "n", "fn", "d", "fnd", "nd"])
def test_native_agrees_with_the_slices(simd: str, read: str) -> None:
    for depth in (True,) if "d" in read else (True, False):
        found = with_gradients(split, torch.float32, read, depth)
        exact = with_gradients(split_reference, torch.float64, read, depth)
        assert len(found) == len(exact)
        for mine, theirs in zip(found, exact, strict=True):
            assert bool(torch.isfinite(mine).all())
            assert_close(mine.double(), theirs, rtol=2e-6, atol=2e-6)


def test_threads_do_not_change_the_result() -> None:
    results = []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        results.append(with_gradients(split, torch.float32, "fnd", True))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_without_further_channels_the_slices_do() -> None:
    features, alpha = torch.rand(*SIZE, 6), torch.rand(SIZE)
    _, normal, depth = split(features, alpha, Layout({"color": 3, "normal": 3}))
    assert normal is not None
    assert torch.equal(normal, features[..., 3:6])
    assert depth is None
    assert split(features, alpha, Layout({"color": 3, "own": 3}))[1] is None
    with pytest.raises(ValueError, match="features: expected color, normal and a further channel"):
        split_native(features, alpha, depth=True)
