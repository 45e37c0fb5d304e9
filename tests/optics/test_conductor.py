"""Fresnel's equations of a conductor against complex amplitudes, their limits and their gradients."""

import cmath
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics

# n and k in green light.
METALS = {"aluminum": (0.96, 6.40), "silver": (0.14, 3.10), "chromium": (3.10, 3.30), "iron": (2.90, 2.90)}


def amplitudes(i: float, index: complex) -> tuple[float, float]:
    """(Rs, Rp) from complex amplitudes."""
    c = math.cos(i)
    t = cmath.sqrt(index * index - math.sin(i) ** 2)
    return abs((c - t) / (c + t)) ** 2, abs((index**2 * c - t) / (index**2 * c + t)) ** 2


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@given(i=st.floats(0, 1.5707), n=st.floats(0.05, 4), k=st.floats(0.05, 9))
def test_reflectances_follow_complex_amplitudes(i: float, n: float, k: float) -> None:
    cosine = scalar(math.cos(i))
    s, p = (float(r) for r in optics.conductor_reflectances(cosine, scalar(n), scalar(k)))
    assert (s, p) == pytest.approx(amplitudes(i, complex(n, k)), abs=1e-10)
    degree = float(optics.conductor_dolp_slope(cosine, scalar(n), scalar(k))) * math.sin(i) ** 2
    assert degree == pytest.approx((s - p) / (s + p), abs=1e-10)


@given(i=st.floats(0, 1.5707), n=st.floats(1.1, 3))
def test_without_absorption_it_is_a_dielectric(i: float, n: float) -> None:
    cosine = scalar(math.cos(i))
    found = optics.conductor_reflectances(cosine, scalar(n), scalar(0.0))
    expected = optics.reflectances_from_cosine(cosine, n)
    assert [float(r) for r in found] == pytest.approx([float(r) for r in expected], abs=1e-10)
    slope = optics.conductor_dolp_slope(cosine, scalar(n), scalar(0.0))
    assert float(slope) == pytest.approx(float(optics.dolp_slopes(cosine, n)[0]), abs=1e-10)


def test_indices_give_their_reflectance_back() -> None:
    r = torch.linspace(0.1, 0.985, 60, dtype=torch.float64)
    n, k = optics.conductor_index(r)
    assert torch.allclose(((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), r, atol=1e-10, rtol=0)
    mean, _ = optics.conductor(torch.ones_like(r), r)
    assert torch.allclose(mean, r, atol=1e-10, rtol=0)
    ends = optics.conductor_index(torch.tensor([0.0, 1.0]))
    assert torch.equal(torch.stack(ends), torch.stack(optics.conductor_index(torch.tensor([0.1, 0.985]))))


@pytest.mark.parametrize("metal", METALS)
def test_the_line_of_indices_keeps_to_metals(metal: str) -> None:
    n, k = METALS[metal]
    r = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    for zenith, tolerance in ((45, 0.01), (60, 0.08)):
        s, p = amplitudes(math.radians(zenith), complex(n, k))
        cosine = scalar(math.cos(math.radians(zenith)))
        found = optics.conductor(cosine, scalar(r))[1] * (1 - cosine**2)
        assert abs(float(found) - (s - p) / (s + p)) < tolerance


def test_gradients_follow_finite_differences() -> None:
    cosine = torch.linspace(0.02, 0.98, 7, dtype=torch.float64)[:, None].requires_grad_()
    n = torch.tensor([0.15, 0.97, 2.9], dtype=torch.float64, requires_grad=True)
    k = torch.tensor([3.1, 6.4, 2.9], dtype=torch.float64, requires_grad=True)
    r = torch.tensor([0.15, 0.55, 0.95], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(optics.conductor_reflectances, (cosine, n, k))
    assert torch.autograd.gradcheck(optics.conductor_dolp_slope, (cosine, n, k))
    assert torch.autograd.gradcheck(optics.conductor, (cosine, r))


def test_single_precision_is_finite_everywhere() -> None:
    cosine = torch.linspace(-0.2, 1.2, 141)[:, None].requires_grad_()
    r = torch.linspace(0, 1, 41).requires_grad_()
    mean, slope = optics.conductor(cosine, r)
    (mean.sum() + slope.sum()).backward()
    for values in (mean, slope, cosine.grad, r.grad):
        assert values is not None
        assert bool(torch.isfinite(values).all())
    assert float(mean.detach().min()) > 0
    assert float(mean.detach().max()) <= 1
    double = optics.conductor(cosine.detach().double(), r.detach().double())
    assert torch.allclose(mean.double(), double[0], atol=1e-5)
    assert torch.allclose(slope.double(), double[1], atol=1e-4, rtol=1e-4)


def test_arrays_come_back_as_arrays() -> None:
    found = optics.conductor(np.array([0.5, 1.0]), np.array([0.9, 0.9]))
    assert all(isinstance(values, np.ndarray) for values in found)
