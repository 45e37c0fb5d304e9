"""Fresnel's equations against textbook forms and complex amplitudes."""

import cmath
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics

HALF_PI = math.pi / 2
indices = st.floats(1.1, 3.0)
zeniths = st.floats(0.0, HALF_PI)
oblique = st.floats(0.02, HALF_PI - 0.02)


def scalar(value: float, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor(value, dtype=dtype)


def textbook(i: float, n: float) -> tuple[float, float]:
    """(Rs, Rp) in the sine and tangent form."""
    r = math.asin(math.sin(i) / n)
    return (math.sin(i - r) / math.sin(i + r)) ** 2, (math.tan(i - r) / math.tan(i + r)) ** 2


@given(i=oblique, n=indices)
def test_reflectances_follow_fresnel(i: float, n: float) -> None:
    rs, rp = optics.reflectances(scalar(i), n)
    assert (float(rs), float(rp)) == pytest.approx(textbook(i, n), rel=1e-9, abs=1e-12)


@given(i=zeniths, n=indices)
def test_energy_is_conserved(i: float, n: float) -> None:
    for reflected, transmitted in zip(
        optics.reflectances(scalar(i), n), optics.transmittances(scalar(i), n), strict=True
    ):
        assert float(reflected + transmitted) == pytest.approx(1.0, abs=1e-14)
        assert 0 <= float(reflected) <= 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1.33, 1.5, 2.4])
def test_normal_incidence(n: float, dtype: torch.dtype) -> None:
    expected = ((n - 1) / (n + 1)) ** 2
    for reflectance in optics.reflectances(scalar(0.0, dtype), n):
        assert float(reflectance) == pytest.approx(expected, rel=8 * torch.finfo(dtype).eps)
    assert float(optics.specular_dolp(scalar(0.0, dtype), n)) == 0
    assert float(optics.diffuse_dolp(scalar(0.0, dtype), n)) == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("zenith", [HALF_PI, 1.8, math.pi])
def test_grazing_incidence_and_beyond(zenith: float, dtype: torch.dtype) -> None:
    for reflectance in optics.reflectances(scalar(zenith, dtype), 1.5):
        assert float(reflectance) == pytest.approx(1.0, abs=8 * torch.finfo(dtype).eps)
        assert float(reflectance) <= 1
    for transmittance in optics.transmittances(scalar(zenith, dtype), 1.5):
        assert 0 <= float(transmittance) <= 8 * torch.finfo(dtype).eps
    assert float(optics.specular_dolp(scalar(zenith, dtype), 1.5)) == pytest.approx(0.0, abs=1e-6)
    limit = float(optics.diffuse_dolp_limit(1.5))
    assert limit == pytest.approx(1.25 / 3.25, abs=1e-15)
    assert float(optics.diffuse_dolp(scalar(zenith, dtype), 1.5)) == pytest.approx(limit, rel=1e-6)


@given(n=indices)
def test_brewster_angle_extinguishes_p(n: float) -> None:
    angle = optics.brewster(n)
    assert float(angle) == pytest.approx(math.atan(n), abs=1e-15)
    assert float(optics.reflectances(angle, n)[1]) < 1e-28
    assert float(optics.specular_dolp(angle, n)) == pytest.approx(1.0, abs=1e-14)


@given(i=oblique, n=indices)
def test_degrees_of_polarization_are_those_of_the_reflectances(i: float, n: float) -> None:
    rs, rp = textbook(i, n)
    assert float(optics.specular_dolp(scalar(i), n)) == pytest.approx((rs - rp) / (rs + rp), abs=1e-9)
    expected = (rs - rp) / (2 - rs - rp)
    assert float(optics.diffuse_dolp(scalar(i), n)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("i", "d"), [(30, 0.01698), (50, 0.05771), (60, 0.09594), (70, 0.15508), (80, 0.24643)]
)
def test_diffuse_check_values(i: float, d: float) -> None:
    assert float(optics.diffuse_dolp(scalar(math.radians(i)), 1.5)) == pytest.approx(d, abs=5e-6)
    assert math.degrees(optics.diffuse_zenith(scalar(d), 1.5)) == pytest.approx(i, abs=0.02)


@pytest.mark.parametrize(("i", "wrong"), [(10, 44), (15, 60), (20, 72), (25, 82)])
def test_diffuse_inverse_of_specular_light_is_badly_wrong(i: float, wrong: float) -> None:
    d = optics.specular_dolp(scalar(math.radians(i)), 1.5)
    assert math.degrees(optics.diffuse_zenith(d, 1.5)) == pytest.approx(wrong, abs=0.6)


@pytest.mark.parametrize(("n", "read"), [(1.3, 48), (1.8, 70)])
def test_wrong_index_shifts_the_zenith(n: float, read: float) -> None:
    d = optics.diffuse_dolp(scalar(math.radians(60)), n)
    assert math.degrees(optics.diffuse_zenith(d, 1.5)) == pytest.approx(read, abs=0.6)


@given(i=zeniths, n=indices)
def test_diffuse_round_trip(i: float, n: float) -> None:
    assert float(optics.diffuse_zenith(optics.diffuse_dolp(scalar(i), n), n)) == pytest.approx(i, abs=1e-7)


@given(d=st.floats(0.0, 1.0), n=indices)
def test_specular_round_trip(d: float, n: float) -> None:
    below, above = optics.specular_zeniths(scalar(d), n)
    assert 0 <= float(below) <= float(optics.brewster(n)) + 1e-15
    assert float(optics.brewster(n)) - 1e-15 <= float(above) <= HALF_PI + 1e-15
    assert float(optics.specular_dolp(below, n)) == pytest.approx(d, abs=1e-12)
    assert float(optics.specular_dolp(above, n)) == pytest.approx(d, abs=1e-12)


@given(i=oblique, n=indices)
def test_one_specular_root_is_the_true_zenith(i: float, n: float) -> None:
    below, above = optics.specular_zeniths(optics.specular_dolp(scalar(i), n), n)
    # Near Brewster's angle the inverse has a square-root singularity and halves the digits.
    assert min(abs(float(below) - i), abs(float(above) - i)) < 1e-6


def test_inverses_at_the_ends() -> None:
    ends = torch.tensor((-0.5, 0.0, 1.0, 1.5), dtype=torch.float64)
    grazing, brewster = HALF_PI, math.atan(1.5)
    below, above = optics.specular_zeniths(ends, 1.5)
    assert below.tolist() == pytest.approx([0, 0, brewster, brewster], abs=1e-12)
    assert above.tolist() == pytest.approx([grazing, grazing, brewster, brewster], abs=1e-12)
    assert optics.diffuse_zenith(ends, 1.5).tolist() == pytest.approx([0, 0, grazing, grazing], abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_diffuse_zenith_never_passes_grazing(dtype: torch.dtype) -> None:
    index = torch.linspace(1.1, 3.0, 1000, dtype=dtype)
    assert (
        optics.diffuse_zenith(torch.ones(1000, dtype=dtype), index) <= torch.tensor(HALF_PI, dtype=dtype)
    ).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("end", [0.0, 1e-30, 1.25 / 3.25, 1.0 - 1e-9, 1.0, HALF_PI, 2.0])
def test_gradient_is_finite_at_the_ends(end: float, dtype: torch.dtype) -> None:
    functions = (
        optics.reflectances,
        optics.transmittances,
        optics.specular_dolp,
        optics.diffuse_dolp,
        optics.diffuse_zenith,
        optics.specular_zeniths,
        optics.dolp_slopes,
        optics.reflectances_from_cosine,
    )
    for function in functions:
        leaf = torch.tensor(end, dtype=dtype, requires_grad=True)
        index = torch.tensor(1.5, dtype=dtype, requires_grad=True)
        values = function(leaf, index)
        total = sum(values) if isinstance(values, tuple) else values
        total.backward()
        assert torch.isfinite(total), function
        assert torch.isfinite(leaf.grad), function
        assert torch.isfinite(index.grad), function


def test_gradients_away_from_the_ends_are_exact() -> None:
    zenith = torch.linspace(0.1, 1.4, 7, dtype=torch.float64, requires_grad=True)
    degree = torch.linspace(0.02, 0.35, 7, dtype=torch.float64, requires_grad=True)
    index = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    for forward in (optics.reflectances, optics.specular_dolp, optics.diffuse_dolp, optics.dolp_slopes):
        assert torch.autograd.gradcheck(forward, (zenith, index))
    for inverse in (optics.diffuse_zenith, optics.specular_zeniths):
        assert torch.autograd.gradcheck(inverse, (degree, index))


@given(
    shape=st.lists(st.integers(0, 3), max_size=3).map(tuple),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_index_per_pixel_over_any_shape(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    zenith = torch.rand(shape, dtype=dtype) * HALF_PI
    index = 1.2 + torch.rand(shape, dtype=dtype)
    for value in (*optics.reflectances(zenith, index), optics.diffuse_dolp(zenith, index)):
        assert value.shape == shape
        assert value.dtype == dtype
        assert ((value >= 0) & (value <= 1)).all()
    back = optics.diffuse_zenith(optics.diffuse_dolp(zenith, index), index)
    assert torch.allclose(back, zenith, atol=0.01)


def test_index_must_exceed_one() -> None:
    with pytest.raises(ValueError, match=r"1\.0"):
        optics.reflectances(scalar(0.3), 1.0)
    with pytest.raises(ValueError, match="index"):
        optics.specular_zeniths(scalar(0.3), 0.7)


# n and k in green light.
METALS = {"aluminum": (0.96, 6.40), "silver": (0.14, 3.10), "chromium": (3.10, 3.30), "iron": (2.90, 2.90)}


def amplitudes(i: float, index: complex) -> tuple[float, float]:
    """(Rs, Rp) from complex amplitudes."""
    c = math.cos(i)
    t = cmath.sqrt(index * index - math.sin(i) ** 2)
    return abs((c - t) / (c + t)) ** 2, abs((index**2 * c - t) / (index**2 * c + t)) ** 2


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


@given(i=st.floats(0, 1.5707), n=st.floats(0.05, 4), k=st.floats(0.05, 9))
def test_the_oblique_share_follows_complex_amplitudes(i: float, n: float, k: float) -> None:
    """U of light with U alone before and after, ``2 Re(-rs rp*) / (|rs|^2 + |rp|^2)``."""
    c, index = math.cos(i), complex(n, k)
    t = cmath.sqrt(index * index - math.sin(i) ** 2)
    s, p = (c - t) / (c + t), (index**2 * c - t) / (index**2 * c + t)
    expected = -2 * (s * p.conjugate()).real / (abs(s) ** 2 + abs(p) ** 2)
    found = optics.conductor_oblique_share(scalar(c), scalar(n), scalar(k))
    assert float(found) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize(
    ("index", "shares"),
    [
        ((0.96, 6.69), (0.98, 0.91, 0.75)),
        ((0.95, 2.58), (0.88, 0.57, 0.11)),
        ((0.36, 2.69), (0.88, 0.57, 0.10)),
    ],
    ids=["aluminum", "copper", "gold"],
)
def test_metals_lose_oblique_polarization_at_large_angles(
    index: tuple[float, float], shares: tuple[float, ...]
) -> None:
    cosine = torch.cos(torch.deg2rad(torch.tensor([45.0, 60.0, 70.0], dtype=torch.float64)))
    found = optics.conductor_oblique_share(cosine, *(scalar(part) for part in index))
    assert found.tolist() == pytest.approx(shares, abs=0.006)


def printed_zenith(d: torch.Tensor, k: float, *, corrected: bool) -> torch.Tensor:
    """The closed form of PolarGuide-GSDR (Shan et al. 2026) for the diffuse zenith, with or without its misprints."""
    a = 2 * (1 - d) - (1 + d) * (k**2 + 1 / k**2)
    b = 4 * d
    c = 1 + k**2
    e = 1 - k**2
    if corrected:
        root = b * torch.sqrt(c**2 * (a + b) ** 2 - e**2 * (a**2 - b**2))
    else:
        root = -torch.sqrt(c**2 * (a + b) ** 2 - e**2 * (a - b) ** 2)
    return torch.asin(torch.sqrt((-b * c * (a + b) + root) / (2 * (a**2 - b**2))))


@pytest.mark.parametrize("n", [1.33, 1.5, 1.8])
def test_the_printed_zenith_is_the_inverse_but_for_three_misprints(n: float) -> None:
    limit = (n**2 - 1) / (n**2 + 1)
    d = torch.linspace(1e-3, 0.999 * limit, 50_000, dtype=torch.float64)
    exact = optics.diffuse_zenith(d, n)
    corrected = printed_zenith(d, n, corrected=True)
    assert float(torch.rad2deg(corrected - exact).abs().max()) < 1e-10


def test_the_zenith_as_printed_is_real_for_few_degrees_of_polarization_and_wrong() -> None:
    d = torch.linspace(1e-4, 0.3845, 100_000, dtype=torch.float64)
    printed = printed_zenith(d, 1.5, corrected=False)
    real = torch.isfinite(printed)
    assert (float(d[real].min()), float(d[real].max())) == pytest.approx((0.1231, 0.1613), abs=1e-4)
    wrong = torch.rad2deg(printed - optics.diffuse_zenith(d, 1.5))[real].abs()
    assert (float(wrong.min()), float(wrong.max())) == pytest.approx((26.0, 64.5), abs=0.5)


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
        assert bool(torch.isfinite(values).all())
    assert float(mean.detach().min()) > 0
    assert float(mean.detach().max()) <= 1
    double = optics.conductor(cosine.detach().double(), r.detach().double())
    assert torch.allclose(mean.double(), double[0], atol=1e-5)
    assert torch.allclose(slope.double(), double[1], atol=1e-4, rtol=1e-4)


def test_arrays_come_back_as_arrays() -> None:
    found = optics.conductor(np.array([0.5, 1.0]), np.array([0.9, 0.9]))
    assert all(isinstance(values, np.ndarray) for values in found)
