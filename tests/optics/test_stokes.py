"""Stokes vectors against Malus's law, and the angles read from them."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics

PI = math.pi
degrees_of_polarization = st.floats(0.0, 1.0)
angles = st.floats(0.0, PI, exclude_max=True)
shapes = st.lists(st.integers(0, 3), max_size=3).map(tuple)
dtypes = st.sampled_from([torch.float32, torch.float64])


def beam(s0: float, degree: float, angle: float) -> torch.Tensor:
    """Stokes vector from its polar form."""
    parts = (s0, s0 * degree * math.cos(2 * angle), s0 * degree * math.sin(2 * angle))
    return torch.tensor(parts, dtype=torch.float64)


@given(angle=angles, polarizer=st.floats(-10, 10))
def test_malus_law(angle: float, polarizer: float) -> None:
    light = beam(2.0, 1.0, angle)
    expected = 2.0 * math.cos(polarizer - angle) ** 2
    assert float(optics.intensity(light, polarizer)) == pytest.approx(expected, abs=1e-13)


def test_polarizer_angle_per_pixel() -> None:
    light = torch.stack([beam(1.0, 1.0, a) for a in (0.1, 0.7)], dim=-1)
    along = optics.intensity(light, torch.tensor((0.1, 0.7), dtype=torch.float64))
    assert torch.allclose(along, torch.ones(2, dtype=torch.float64))


@given(s0=st.floats(0.01, 100), degree=degrees_of_polarization, angle=angles)
def test_four_polarizer_angles_determine_the_stokes_vector(s0: float, degree: float, angle: float) -> None:
    light = beam(s0, degree, angle)
    images = torch.stack([optics.intensity(light, math.radians(a)) for a in optics.ANGLES])
    assert torch.allclose(optics.stokes(images), light, rtol=0, atol=1e-13 * s0)
    assert float(optics.photograph(light)) == pytest.approx(float(images.mean()), rel=1e-13)


@given(degree=st.floats(0.001, 1.0), angle=st.floats(0.0, PI - 1e-9))
def test_polar_form_round_trip(degree: float, angle: float) -> None:
    light = beam(0.3, degree, angle)
    assert float(optics.dolp(light)) == pytest.approx(degree, abs=1e-14)
    difference = float(optics.aolp(light)) - angle
    assert abs(math.remainder(difference, PI)) < 1e-12


@pytest.mark.parametrize(("first", "angle"), [((1.0, 0.0, 0.0, 0.0), 0.0), ((0.0, 1.0, 0.0, 0.0), PI / 4)])
def test_brightest_image_names_the_angle(first: tuple[float, ...], angle: float) -> None:
    light = optics.stokes(torch.tensor(first, dtype=torch.float64))
    assert float(optics.aolp(light)) == pytest.approx(angle, abs=1e-15)
    light = optics.stokes(torch.tensor(first, dtype=torch.float64).roll(2))
    assert float(optics.aolp(light)) == pytest.approx(angle + PI / 2, abs=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("s2", [0.0, -0.0, -1e-30, 1e-30, -1e-8, -0.5])
@pytest.mark.parametrize("s1", [-1.0, 0.0, 1.0])
def test_aolp_lies_in_the_half_open_half_turn(s1: float, s2: float, dtype: torch.dtype) -> None:
    angle = optics.aolp(torch.tensor((1.0, s1, s2), dtype=dtype))
    assert 0 <= float(angle) < PI
    assert angle < torch.tensor(PI, dtype=dtype)


@pytest.mark.parametrize(
    ("light", "degree"),
    [
        ((1.0, 0.0, 0.0), 0.0),
        ((1.0, 0.6, 0.8), 1.0),
        ((1.0, 3.0, 4.0), 1.0),
        ((0.0, 0.0, 0.0), 0.0),
        ((0.0, 1.0, 0.0), 0.0),
        ((-1.0, 0.5, 0.0), 0.0),
        ((1e-30, 1.0, 1.0), 1.0),
    ],
)
def test_dolp_at_its_limits(light: tuple[float, ...], degree: float) -> None:
    assert float(optics.dolp(torch.tensor(light, dtype=torch.float64))) == pytest.approx(degree, abs=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("function", [optics.dolp, optics.aolp])
@pytest.mark.parametrize(
    "light",
    [
        (0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0),
        (1.0, 1.0, 0.0),
        (-1.0, 0.2, 0.1),
        (1e-37, 1.0, 1.0),
        (1.0, 1e-30, 1e-30),
    ],
)
def test_gradient_is_finite_without_light_or_polarization(
    light: tuple[float, ...], function: object, dtype: torch.dtype
) -> None:
    leaf = torch.tensor(light, dtype=dtype, requires_grad=True)
    value = function(leaf)  # type: ignore[operator]
    value.backward()
    assert torch.isfinite(value)
    assert torch.isfinite(leaf.grad).all()


def test_gradients_away_from_the_limits_are_exact() -> None:
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(3, 5, generator=generator, dtype=torch.float64) * 0.4 + 0.1
    light[0] += 1
    light.requires_grad_()
    assert torch.autograd.gradcheck(optics.dolp, light)
    assert torch.autograd.gradcheck(optics.aolp, light)


def test_average_stokes_vectors_never_angles() -> None:
    # Either side of 0 = pi: the mean of the angles would be pi/2, the angle of the mean is 0.
    light = torch.stack([beam(1.0, 0.5, 0.1), beam(1.0, 0.5, PI - 0.1), beam(1.0, 0.5, 0.0)], dim=-1)
    mean = float(optics.aolp(optics.luminance(light)))
    assert abs(math.remainder(mean, PI)) < 1e-12
    assert float(optics.aolp(light).mean()) > 1.0


def test_luminance_is_the_mean_over_the_colors() -> None:
    light = torch.tensor([[0.1, 0.2, 0.6], [0.0, 0.1, 0.2], [-0.3, 0.0, 0.0]], dtype=torch.float64)
    assert optics.luminance(light).tolist() == pytest.approx([0.3, 0.1, -0.1])


@given(shape=shapes, dtype=dtypes)
def test_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    light = optics.stokes(torch.rand(4, *shape, 3, dtype=dtype))
    assert light.shape == (3, *shape, 3)
    for function in (optics.dolp, optics.aolp, optics.photograph):
        value = function(light)
        assert value.shape == (*shape, 3)
        assert value.dtype == dtype
        assert torch.isfinite(value).all()
    assert optics.luminance(light).shape == (3, *shape)
    assert ((optics.dolp(light) >= 0) & (optics.dolp(light) <= 1)).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_runs(dtype: torch.dtype) -> None:
    light = beam(1.0, 0.5, 0.4)
    half = light.to(dtype)
    assert float(optics.dolp(half)) == pytest.approx(0.5, abs=0.01)
    assert float(optics.aolp(half)) == pytest.approx(0.4, abs=0.01)


def test_wrong_number_of_images_is_named() -> None:
    with pytest.raises(ValueError, match=r"expected shape \[4, \.\.\.\], found \[3, 2\]"):
        optics.stokes(torch.zeros(3, 2))
    with pytest.raises(ValueError, match="stokes"):
        optics.dolp(torch.zeros(4))
