"""Spherical harmonics: the kernel against its reference implementation, both against theory and finite differences."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.gaussians.harmonics import evaluate_sh, evaluate_sh_reference, sh_basis

degrees = pytest.mark.parametrize("degree", [0, 1, 2, 3])
CENTER = torch.tensor([0.3, -0.2, 0.1])


def gaussians(count: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    shapes = ((count, 3), (count, 3), (count, 15, 3))
    means, dc, rest = (torch.randn(*shape, generator=generator, dtype=dtype) for shape in shapes)
    return means, dc, rest


def with_gradients(function, inputs: tuple[Tensor, ...], degree: int) -> list[Tensor]:
    """Output and gradients of a fixed weighted sum of it."""
    leaves = [t.detach().clone().requires_grad_() for t in inputs]
    out = function(leaves[0], CENTER.to(leaves[0]), leaves[1], leaves[2], degree)
    weights = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape)
    (out * weights).sum().backward()
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
    return [out.detach(), *gradients]


@degrees
@pytest.mark.parametrize("count", [1, 15, 16, 17, 1000])
def test_kernel_agrees_with_the_reference(simd: str, degree: int, count: int) -> None:
    inputs = gaussians(count)
    exact = with_gradients(evaluate_sh_reference, tuple(t.double() for t in inputs), degree)
    for found, expected in zip(with_gradients(evaluate_sh, inputs, degree), exact, strict=True):
        assert_close(found.double(), expected, rtol=1e-5, atol=2e-6 * (1 + float(expected.abs().max())))


@degrees
def test_gradient_of_the_reference(degree: int) -> None:
    inputs = [t.requires_grad_() for t in gaussians(3, torch.float64)]
    torch.autograd.gradcheck(
        lambda m, d, r: evaluate_sh_reference(m, CENTER.double(), d, r, degree),
        inputs,
        check_undefined_grad=False,
    )


def test_basis_is_orthonormal() -> None:
    """Products of two basis functions integrate to the identity over the sphere (by exact quadrature)."""
    turns = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16) + 0.1
    k = torch.arange(1, 12, dtype=torch.float64)
    off = (
        k / (4 * k * k - 1).sqrt()
    )  # Jacobi matrix of the Legendre polynomials: its eigenvalues are the Gauss nodes
    z, vectors = torch.linalg.eigh(torch.diag(off, 1) + torch.diag(off, -1))
    weights = 2 * vectors[0] ** 2
    radius = (1 - z * z).sqrt()
    x, y = radius[:, None] * turns.cos(), radius[:, None] * turns.sin()
    basis = sh_basis(torch.stack((x, y, z[:, None].expand_as(x)), dim=-1), 3)
    gram = torch.einsum("i,ijk,ijl->kl", weights * 2 * math.pi / 16, basis, basis)
    assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-7)


def test_order_and_signs_of_the_first_degrees() -> None:
    axes = sh_basis(torch.eye(3, dtype=torch.float64), 2)
    c1 = math.sqrt(3 / (4 * math.pi))
    assert_close(axes[:, 1:4], c1 * torch.tensor([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]).double())
    assert_close(axes[:, 6], math.sqrt(5 / (16 * math.pi)) * torch.tensor([-1, -1, 2]).double())
    assert_close(axes[:, 8], math.sqrt(15 / (16 * math.pi)) * torch.tensor([1, -1, 0]).double())


@degrees
def test_coefficients_beyond_the_degree_get_no_gradient(simd: str, degree: int) -> None:
    *_, to_rest = with_gradients(evaluate_sh, gaussians(21), degree)
    used = (degree + 1) ** 2 - 1
    assert not to_rest[:, used:].any()
    assert bool((to_rest[:, :used] != 0).all())


def test_moving_along_the_ray_changes_nothing(simd: str) -> None:
    inputs = gaussians(40)
    means, to_means = inputs[0], with_gradients(evaluate_sh, inputs, 3)[1]
    along = ((means - CENTER) * to_means).sum(dim=1)
    assert_close(along, torch.zeros(40), rtol=0, atol=1e-5)


def test_threads_do_not_change_a_bit(simd: str) -> None:
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        results.append(with_gradients(evaluate_sh, gaussians(10_000), 3))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@degrees
def test_directions_without_gradient_leave_the_others_as_they_are(simd: str, degree: int) -> None:
    means, dc, rest = gaussians(37)
    _, to_means, *expected = with_gradients(evaluate_sh, (means, dc, rest), degree)
    assert bool(to_means.any()) == (degree > 0)
    leaves = [dc.clone().requires_grad_(), rest.clone().requires_grad_()]
    out = evaluate_sh(means, CENTER, *leaves, degree)
    (out * torch.linspace(-1, 1, out.numel()).reshape(out.shape)).sum().backward()
    assert all(torch.equal(leaf.grad, gradient) for leaf, gradient in zip(leaves, expected, strict=True))


def test_gaussian_at_the_camera_center(simd: str) -> None:
    means, dc, rest = gaussians(2)
    means[1] = CENTER
    for function in (evaluate_sh, evaluate_sh_reference):
        out, to_means, _, _ = with_gradients(function, (means, dc, rest), 1)
        assert_close(out[1], 0.28209479 * dc[1])
        assert not to_means[1].any()


def test_not_a_number_stays_in_its_row(simd: str) -> None:
    means, dc, rest = gaussians(20)
    means[3, 0] = torch.nan
    out, to_means, _, _ = with_gradients(evaluate_sh, (means, dc, rest), 3)
    assert out[3].isnan().all()
    assert to_means[3].isnan().all()
    kept = torch.arange(20) != 3
    assert out[kept].isfinite().all()
    assert to_means[kept].isfinite().all()


def test_no_gaussians(simd: str) -> None:
    assert [tuple(t.shape) for t in with_gradients(evaluate_sh, gaussians(0), 3)] == [(0, 3)] * 3 + [
        (0, 15, 3)
    ]


def test_other_memory_layouts_and_center_types() -> None:
    means, dc, rest = gaussians(33)
    expected = evaluate_sh(means, CENTER, dc, rest, 3)
    strided = rest.transpose(0, 1).contiguous().transpose(0, 1)
    assert torch.equal(evaluate_sh(means, CENTER.double(), dc, strided, 3), expected)


def test_errors_name_what_was_expected() -> None:
    means, dc, rest = gaussians(4)
    with pytest.raises(ValueError, match=r"rest: .*\[4, 15, 3\].*\[4, 8, 3\]"):
        evaluate_sh(means, CENTER, dc, rest[:, :8], 2)
    with pytest.raises(ValueError, match="degree"):
        evaluate_sh(means, CENTER, dc, rest, 4)
    with pytest.raises(ValueError, match="degree"):
        sh_basis(means, 4)
    with pytest.raises(ValueError, match=r"dc: .*\[4, 3\].*\[3, 3\]"):
        _native.harmonics_forward(1, means, CENTER, dc[:3], rest, torch.empty(4, 3))


@degrees
def test_gradients_that_are_more_than_caches_hold_are_the_same(simd: str, degree: int) -> None:
    """They are written past the caches; those of a few Gaussians are not."""
    count, few = 50_003, slice(49_984, None)  # over 8 MiB; the last block is short
    means, dc, rest = gaussians(count)
    gradient = torch.randn(count, 3, generator=torch.Generator().manual_seed(3))

    def backward(of: slice) -> list[Tensor]:
        given = [t[of].contiguous() for t in (means, dc, rest, gradient)]
        to = [torch.full_like(t, torch.nan) for t in given[:3]]
        _native.harmonics_backward(degree, given[0], CENTER, given[1], given[2], given[3], *to)
        return to

    for many, alone in zip(backward(slice(None)), backward(few), strict=True):
        assert torch.equal(many[few], alone)
        assert torch.isfinite(many).all()
