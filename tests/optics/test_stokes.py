"""Stokes vectors, analyzers and uncertainties against textbook values, loops and simulated noise."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics
from polarguide.geometry.camera import Camera

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
    with pytest.raises(ValueError, match=r"\[4, \.\.\.\].*\[3, 2\]"):
        optics.stokes(torch.zeros(3, 2))
    with pytest.raises(ValueError, match="stokes"):
        optics.dolp(torch.zeros(4))


EYE = torch.eye(3, dtype=torch.float64)
CAMERA = Camera(40, 30, 52.0, 52.0, 20.0, 15.0, EYE, torch.zeros(3, dtype=torch.float64))
RAYS = CAMERA.rays(dtype=torch.float64)
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0, 133.0])
def test_on_the_axis_a_filter_is_what_its_angle_says(degrees: float) -> None:
    twice = math.radians(2 * degrees)
    expected = torch.tensor([math.cos(twice), math.sin(twice)], dtype=torch.float64)
    assert torch.allclose(optics.filter_analyzer(math.radians(degrees), AXIS), expected, atol=1e-12)
    assert torch.allclose(optics.analyzer(math.radians(degrees), AXIS), expected, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 135.0])
def test_a_filter_passes_the_field_across_ray_and_absorption_axis(degrees: float) -> None:
    """Light polarized along the field that it passes is passed whole, light along the sheet's absorption axis, as far
    as a field across the ray can lie along it, not at all."""
    theta = math.radians(degrees)
    absorbing = torch.tensor([-math.sin(theta), -math.cos(theta), 0.0], dtype=torch.float64)
    absorbed = absorbing - (RAYS @ absorbing)[..., None] * RAYS
    passed = torch.linalg.cross(RAYS, absorbing.expand_as(RAYS))
    analyzer = optics.filter_analyzer(theta, RAYS)
    for field, share in ((passed, 1.0), (absorbed, 0.0)):
        azimuth = optics.azimuth(field, RAYS)
        stokes = torch.stack((torch.ones_like(azimuth), torch.cos(2 * azimuth), torch.sin(2 * azimuth)))
        through = (stokes[0] + stokes[1] * analyzer[0] + stokes[2] * analyzer[1]) / 2
        assert torch.allclose(through, torch.full_like(through, share), atol=1e-12)


def test_off_the_axis_a_filter_turns_by_half_of_x_y() -> None:
    cosine, sine = optics.filter_analyzer(0.0, RAYS)
    turned = torch.atan2(sine, cosine) / 2
    x, y = RAYS[..., 0] / RAYS[..., 2], RAYS[..., 1] / RAYS[..., 2]
    assert float(turned.abs().max()) > math.radians(2)
    assert torch.allclose(turned.abs(), (x * y / 2).abs(), atol=0.15 * float(turned.abs().max()))
    other = optics.filter_analyzer(math.pi / 2, RAYS)
    across = torch.atan2(other[1], -other[0]) / -2
    assert torch.allclose(
        turned, -across, atol=0.2 * float(turned.abs().max())
    )  # they turn against each other


@pytest.mark.parametrize("mount", ["sensor", "filter"])
@pytest.mark.parametrize("degrees", [(0.0, 60.0, 120.0), (10.0, 35.0, 80.0, 100.0), (0.0, 45.0, 90.0, 135.0)])
def test_least_squares_give_back_stokes_vectors(mount: optics.Mount, degrees: tuple[float, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    stokes = torch.randn(3, 30, 40, 3, generator=generator, dtype=torch.float64)
    analyzers = torch.stack([optics.analyzer(math.radians(angle), RAYS, mount) for angle in degrees])
    spread = analyzers if mount == "filter" else analyzers[..., None, None]
    parts = [(stokes[0] + stokes[1] * c[..., None] + stokes[2] * s[..., None]) / 2 for c, s in spread]
    assert torch.allclose(optics.fitted_stokes(torch.stack(parts), analyzers), stokes, atol=1e-10)


def test_four_angles_give_what_the_closed_form_gives() -> None:
    four = torch.rand(4, 5, 6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    analyzers = torch.stack([optics.analyzer(k * math.pi / 4, AXIS) for k in range(4)])
    assert torch.allclose(optics.fitted_stokes(four, analyzers), optics.stokes(four), atol=1e-12)


def test_as_many_analyzers_as_intensities_are_asked_for() -> None:
    with pytest.raises(ValueError, match="intensities"):
        optics.fitted_stokes(torch.rand(3, 2, 2, 3), torch.zeros(4, 2))


DRAWS = 200_000


def measured(degree: float, angle: float, sigmas: tuple[float, ...], s0: float = 0.8):
    """Stokes vectors [3, N] of one light, drawn with independent noise on the four intensities."""
    rng = torch.Generator().manual_seed(1)
    true = s0 * torch.tensor([1.0, degree * math.cos(2 * angle), degree * math.sin(2 * angle)]).double()
    clean = torch.stack([optics.intensity(true, math.radians(a)) for a in optics.ANGLES])
    noise = (
        torch.randn((4, DRAWS), generator=rng, dtype=torch.float64) * torch.tensor(sigmas)[:, None].double()
    )
    return true, optics.stokes(clean[:, None] + noise)


@pytest.mark.parametrize("degree", [0.1, 0.35, 0.8])
@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 2.9])
@pytest.mark.parametrize("sigmas", [(0.004,) * 4, (0.008, 0.002, 0.003, 0.006)])
def test_standard_deviations_are_those_of_drawn_noise(
    degree: float, angle: float, sigmas: tuple[float, ...]
) -> None:
    true, drawn = measured(degree, angle, sigmas)
    found = optics.polarization_uncertainty(true, torch.tensor(sigmas).double() ** 2)
    assert float(optics.dolp(drawn).std()) == pytest.approx(float(found.dolp), rel=0.03)
    off = torch.remainder(optics.aolp(drawn) - angle + math.pi / 2, math.pi) - math.pi / 2
    assert float(off.square().mean().sqrt()) == pytest.approx(float(found.aolp), rel=0.05)


def test_the_debiased_degree_is_right_on_average_where_the_measured_one_is_not() -> None:
    sigma = 0.02
    variances = torch.full((4, 1), sigma**2, dtype=torch.float64)
    for degree in (0.08, 0.12, 0.2):  # 2.3, 3.4 and 5.7 standard deviations
        true, drawn = measured(degree, 0.7, (sigma,) * 4)
        spread = float(optics.polarization_uncertainty(true, variances[:, 0]).dolp)
        debiased = optics.polarization_uncertainty(drawn, variances).debiased
        biased = float(optics.dolp(drawn).mean()) - degree
        assert biased > 0.07 * spread
        assert abs(float(debiased.mean()) - degree) < 0.3 * biased
    _, nothing = measured(0.0, 0.0, (sigma,) * 4)
    left = optics.polarization_uncertainty(nothing, variances).debiased.mean()
    assert float(left) == pytest.approx(0.79 * float(optics.dolp(nothing).mean()), rel=0.02)


def test_without_polarization_the_angle_is_uniform() -> None:
    _, drawn = measured(0.0, 0.0, (0.01,) * 4)
    off = optics.aolp(drawn) - math.pi / 2
    assert float(off.std()) == pytest.approx(optics.UNIFORM_SPREAD, rel=0.01)
    found = optics.polarization_uncertainty(torch.tensor([1.0, 0.0, 0.0]), torch.full((4,), 1e-4))
    assert float(found.aolp) == pytest.approx(optics.UNIFORM_SPREAD)
    assert float(found.debiased) == 0.0


def test_no_light() -> None:
    found = optics.polarization_uncertainty(torch.zeros(3, 2), torch.full((4, 2), 1e-4))
    assert torch.isinf(found.dolp).all()
    assert not found.debiased.any()
    assert torch.isfinite(found.aolp).all()


def test_no_noise_leaves_the_degree() -> None:
    stokes = torch.tensor([[1.0], [0.3], [-0.4]])
    found = optics.polarization_uncertainty(stokes, torch.zeros(4, 1))
    np.testing.assert_allclose(found.debiased, 0.5, rtol=1e-6)
    assert float(found.dolp) == float(found.aolp) == 0.0


def test_wrong_shapes() -> None:
    with pytest.raises(ValueError, match="variances: "):
        optics.polarization_uncertainty(torch.zeros(3, 2), torch.zeros(3, 2))


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_aolp_is_below_pi_in_every_precision(kind):
    """A tiny negative angle is the angle 0, which rounding must not show as pi beside it."""
    tiny = -(10.0 ** torch.arange(-20, -1, dtype=torch.float64))
    stokes = torch.stack((torch.ones_like(tiny), torch.ones_like(tiny), tiny)).to(kind)
    angles = optics.aolp(stokes)
    assert (angles >= 0).all()
    assert (angles < torch.tensor(math.pi, dtype=kind)).all()
    assert (angles.double() < math.pi).all()
