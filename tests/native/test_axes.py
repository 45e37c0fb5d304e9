"""Shortest axes and mirrored rays: the kernels against their reference implementations, forward and gradient."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.gaussians.geometry import (
    mirrored_directions,
    shortest_axis_normals,
    shortest_axis_normals_reference,
)

CENTER = torch.tensor([0.3, -0.2, 1.1])


def gaussians(count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    means, quaternions, log_scales, outward = (
        torch.randn(count, size, generator=generator) for size in (3, 4, 3, 3)
    )
    outward[::3] = 0  # not known
    return means, quaternions, log_scales, outward


def with_gradient(function, shape: tuple[Tensor, ...], center: Tensor) -> tuple[Tensor, Tensor]:
    means, quaternions, *others = (t.detach().clone() for t in shape)
    quaternions.requires_grad_()
    out = function(means, quaternions, others[0], center, *others[1:])
    weights = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape)
    (out * weights).sum().backward()
    assert quaternions.grad is not None
    return out.detach(), quaternions.grad


@pytest.mark.parametrize("oriented", [False, True])
@pytest.mark.parametrize("count", [1, 17, 10_000])
def test_kernel_agrees_with_the_reference(simd: str, count: int, oriented: bool) -> None:
    shape = gaussians(count)[: 4 if oriented else 3]
    found = with_gradient(shortest_axis_normals, shape, CENTER)
    exact = with_gradient(shortest_axis_normals_reference, tuple(t.double() for t in shape), CENTER.double())
    for name, mine, reference in zip(("normals", "gradient"), found, exact, strict=True):
        scale = 1 + float(reference.abs().max()) if name == "gradient" else 1.0
        assert_close(mine.double(), reference, rtol=1e-5, atol=2e-6 * scale)


def test_threads_do_not_change_the_result() -> None:
    shape = gaussians(20_000)
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        results.append(with_gradient(shortest_axis_normals, shape, CENTER))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_no_gaussian_and_no_length_are_no_trouble() -> None:
    none = shortest_axis_normals(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), CENTER)
    assert none.shape == (0, 3)
    flat = (torch.zeros(1, 3), torch.zeros(1, 4), torch.tensor([[0.0, 0.0, -1.0]]))
    normal, gradient = with_gradient(shortest_axis_normals, flat, CENTER)
    assert_close(normal, torch.tensor([[0.0, 0.0, 1.0]]))
    assert torch.isfinite(gradient).all()


def test_mirrored_directions_agree_with_the_reference(simd: str) -> None:
    means, quaternions, log_scales, _ = gaussians(1000)
    means[5] = CENTER
    normals = shortest_axis_normals(means, quaternions, log_scales, CENTER)
    found = mirrored_directions(means, CENTER, normals)
    reference = mirrored_directions(means.double(), CENTER.double(), normals.double())
    assert_close(found.double(), reference, rtol=1e-5, atol=2e-6)
    assert_close(found[5], torch.zeros(3))
    others = torch.arange(1000) != 5
    assert_close(found[others].norm(dim=1), torch.ones(999))
    rays = torch.nn.functional.normalize(means - CENTER, dim=1)
    assert_close((found * normals).sum(1)[others], -(rays * normals).sum(1)[others], atol=1e-5, rtol=1e-5)


def test_wrong_shapes_are_refused() -> None:
    means, quaternions, log_scales, _ = gaussians(4)
    with pytest.raises(ValueError, match=r"quaternions: expected shape \[4, 4\], found \[3, 4\]"):
        shortest_axis_normals(means, quaternions[:3], log_scales, CENTER)
