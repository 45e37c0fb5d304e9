"""The separation of layers, and circular polarizers, against forward models."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics
from polarguide.geometry.polarizer import ANGLES, malus

F64 = torch.float64


def scene(count: int = 200, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Random rays, normals that face the camera at 12 to 86 degrees, and two layers."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    plane = uniform(count, 2) * 2 - 1
    rays = torch.nn.functional.normalize(torch.cat((plane, torch.ones(count, 1, dtype=F64)), -1), dim=-1)
    polar = 0.21 + uniform(count) * 1.3
    normals = optics.normal_from_angles(polar, uniform(count) * 2 * math.pi, rays)
    return rays, normals, uniform(count, 3), uniform(count, 3)


def test_prediction_of_a_pure_lobe_has_the_fresnel_polarization() -> None:
    rays, normals, layer, _ = scene()
    nothing = torch.zeros_like(layer)
    polar = optics.zenith(normals, rays)
    specular = optics.predicted_stokes(layer, nothing, normals, rays)
    diffuse = optics.predicted_stokes(nothing, layer, normals, rays)
    assert torch.allclose(optics.dolp(specular)[:, 0], optics.specular_dolp(polar), atol=1e-12)
    assert torch.allclose(optics.dolp(diffuse)[:, 0], optics.diffuse_dolp(polar), atol=1e-12)


def test_predicted_field_is_perpendicular_or_in_the_plane_of_incidence() -> None:
    rays, normals, layer, _ = scene()
    nothing = torch.zeros_like(layer)
    perpendicular = torch.linalg.cross(rays, normals)
    in_plane = torch.linalg.cross(rays, perpendicular)
    for field, light in (
        (perpendicular, optics.predicted_stokes(layer, nothing, normals, rays)),
        (in_plane, optics.predicted_stokes(nothing, layer, normals, rays)),
    ):
        difference = optics.aolp(light)[:, 0] - optics.azimuth(field, rays)
        assert torch.sin(difference).abs().max() < 1e-10


@pytest.mark.parametrize("index", [1.33, 1.5, 1.8])
def test_exact_separation_inverts_the_prediction(index: float) -> None:
    rays, normals, specular, diffuse = scene()
    light = optics.predicted_stokes(specular, diffuse, normals, rays, index)
    found = optics.exact_separation(light, normals, rays, index, minimum_contrast=0.02)
    assert found.conditioned.all()
    assert torch.allclose(found.specular, specular, atol=1e-11)
    assert torch.allclose(found.diffuse, diffuse, atol=1e-11)


def test_index_per_pixel() -> None:
    rays, normals, specular, diffuse = scene()
    index = torch.linspace(1.3, 1.9, len(rays), dtype=F64)
    light = optics.predicted_stokes(specular, diffuse, normals, rays, index)
    found = optics.exact_separation(light, normals, rays, index)
    assert torch.allclose(found.specular[found.conditioned], specular[found.conditioned], atol=1e-11)


def test_layers_stay_between_nothing_and_everything() -> None:
    rays, normals, *_ = scene()
    light = torch.randn(3, len(rays), 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    found = optics.exact_separation(light, normals, rays)
    total = light[0].clamp(min=0)
    assert (found.specular >= 0).all()
    assert (found.specular <= total).all()
    assert torch.allclose(found.specular + found.diffuse, total)


@pytest.mark.parametrize(
    ("degrees", "conditioned"), [(0, False), (10.5, False), (11.5, True), (80, True), (100, False)]
)
def test_conditioning_begins_at_about_eleven_degrees(degrees: float, conditioned: bool) -> None:
    rays = torch.tensor((0.0, 0.0, 1.0), dtype=F64)
    polar = torch.tensor(math.radians(degrees), dtype=F64)
    normal = optics.normal_from_angles(polar, torch.tensor(0.4, dtype=F64), rays)
    found = optics.exact_separation(torch.ones(3, 3, dtype=F64), normal, rays)
    assert found.conditioned.shape == ()
    assert bool(found.conditioned) is conditioned


def test_zero_normal_is_not_conditioned_and_predicts_no_polarization() -> None:
    rays, normals, specular, diffuse = scene(5)
    nothing = torch.zeros_like(normals)
    light = optics.predicted_stokes(specular, diffuse, nothing, rays)
    assert not optics.exact_separation(light, nothing, rays).conditioned.any()
    assert (light[1:] == 0).all()
    assert torch.equal(light[0], specular + diffuse)


def test_length_of_the_normal_does_not_matter() -> None:
    rays, normals, specular, diffuse = scene()
    light = optics.predicted_stokes(specular, diffuse, normals, rays)
    assert torch.allclose(optics.predicted_stokes(specular, diffuse, 0.3 * normals, rays), light)
    found = optics.exact_separation(light, 0.3 * normals, rays)
    assert torch.allclose(found.specular, optics.exact_separation(light, normals, rays).specular)


@pytest.mark.parametrize(("degrees", "share"), [(0, 0.040), (56.31, 0.074), (80, 0.388)])
def test_paper_share_depends_on_the_zenith_alone(degrees: float, share: float) -> None:
    polar = torch.tensor([math.radians(degrees)], dtype=F64)
    for brightness in (0.1, 10.0):
        light = torch.full((3, 1, 3), brightness, dtype=F64)
        found = optics.paper_separation(light, polar)
        assert (found.specular / light[0]).flatten().tolist() == pytest.approx([share] * 3, abs=5e-4)
        reflected = found.specular / light[0]
        assert torch.allclose(found.diffuse / light[0], (1 - reflected) ** 2)
        assert found.conditioned.all()


def test_paper_separation_is_the_mean_over_the_polarizer_angles() -> None:
    rays, normals, specular, diffuse = scene()
    light = optics.predicted_stokes(specular, diffuse, normals, rays)
    polar = optics.zenith(normals, rays)
    s_direction = optics.azimuth(normals, rays) + math.pi / 2
    images = [optics.paper_intensities(light, polar, s_direction, math.radians(a)) for a in optics.ANGLES]
    found = optics.paper_separation(light, polar)
    for layer, mean in zip(
        found[:2], (torch.stack(pair).mean(0) for pair in zip(*images, strict=True)), strict=True
    ):
        assert torch.allclose(mean, layer / 2, atol=1e-14)


def test_paper_intensity_peaks_along_s_for_specular_and_p_for_diffuse_light() -> None:
    polar, direction = torch.tensor(0.9, dtype=F64), torch.tensor(0.6, dtype=F64)
    light = torch.ones(3, 3, dtype=F64)
    rs, rp = optics.reflectances(polar)
    ts, tp = optics.transmittances(polar)
    left = 1 - (rs + rp) / 2
    along_s = optics.paper_intensities(light, polar, direction, 0.6)
    along_p = optics.paper_intensities(light, polar, direction, 0.6 + math.pi / 2)
    for value, expected in (
        (along_s[0], rs / 2),
        (along_p[0], rp / 2),
        (along_s[1], left * ts / 2),
        (along_p[1], left * tp / 2),
    ):
        assert torch.allclose(value, expected.expand(3), atol=1e-14)


@given(roll=st.floats(-3, 3))
def test_separation_does_not_change_when_the_camera_rolls(roll: float) -> None:
    rays, normals, specular, diffuse = scene(20)
    c, s = math.cos(roll), math.sin(roll)
    turn = torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=F64)
    rays_rolled, normals_rolled = rays @ turn.T, normals @ turn.T
    light = optics.predicted_stokes(specular, diffuse, normals, rays)
    rolled = optics.predicted_stokes(specular, diffuse, normals_rolled, rays_rolled)
    # Image right turns toward image down, so angles measured counter-clockwise shrink by the roll.
    expected_s1 = light[1] * math.cos(2 * roll) + light[2] * math.sin(2 * roll)
    assert torch.allclose(rolled[1], expected_s1, atol=1e-12)
    before = optics.exact_separation(light, normals, rays)
    after = optics.exact_separation(rolled, normals_rolled, rays_rolled)
    assert torch.allclose(before.specular, after.specular, atol=1e-11)
    for polarizer in (0.0, 0.5):
        angle = (
            optics.azimuth(normals, rays) + math.pi / 2,
            optics.azimuth(normals_rolled, rays_rolled) + math.pi / 2,
        )
        polar = optics.zenith(normals, rays), optics.zenith(normals_rolled, rays_rolled)
        cue = optics.paper_intensities(light, polar[0], angle[0], polarizer)[0]
        cue_rolled = optics.paper_intensities(rolled, polar[1], angle[1], polarizer - roll)[0]
        assert torch.allclose(cue, cue_rolled, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tilt", [0.0, 1e-30, 1e-12, 1e-6, 1e-3])
@pytest.mark.parametrize("facing", [-1.0, 0.0, 1e-20, 1.0])
def test_gradient_is_finite_at_every_degenerate_normal(
    facing: float, tilt: float, dtype: torch.dtype
) -> None:
    normal = torch.tensor((tilt, 0.0, facing), dtype=dtype, requires_grad=True)
    rays = torch.tensor((0.0, 0.0, 1.0), dtype=dtype)
    for level in (0.0, 0.5):
        layers = torch.full((2, 3), level, dtype=dtype, requires_grad=True)
        light = torch.tensor(((level,) * 3, (0.0,) * 3, (0.0,) * 3), dtype=dtype, requires_grad=True)
        predicted = optics.predicted_stokes(layers[0], layers[1], normal, rays)
        separated = optics.exact_separation(light, normal, rays)
        paper = optics.paper_separation(light, optics.zenith(normal, rays))
        total = predicted.sum() + separated.specular.sum() + paper.specular.sum() + paper.diffuse.sum()
        leaves = (normal, layers, light)
        assert torch.isfinite(total)
        for gradient in torch.autograd.grad(total, leaves):
            assert torch.isfinite(gradient).all()


def test_prediction_is_smooth_through_normal_incidence() -> None:
    rays = torch.tensor((0.1, -0.2, 0.97), dtype=F64)
    rays = rays / rays.norm()
    normal = (-rays).clone().requires_grad_()
    layers = torch.tensor(((0.3, 0.4, 0.5), (0.2, 0.1, 0.6)), dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda n, a: optics.predicted_stokes(a[0], a[1], n, rays), (normal, layers)
    )


def test_gradients_of_the_separation_are_exact() -> None:
    rays, normals, specular, diffuse = scene(5)
    light = optics.predicted_stokes(specular, diffuse, normals, rays).requires_grad_()
    normals = normals.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda s, n: optics.exact_separation(s, n, rays).specular, (light, normals)
    )


@given(
    shape=st.lists(st.integers(0, 3), max_size=3).map(tuple),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    rays = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=dtype), dim=-1)
    normals = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=dtype), dim=-1)
    layer = torch.rand(*shape, 3, dtype=dtype)
    light = optics.predicted_stokes(layer, layer, normals, rays)
    assert light.shape == (3, *shape, 3)
    assert light.dtype == dtype
    for found in (
        optics.exact_separation(light, normals, rays),
        optics.paper_separation(light, optics.zenith(normals, rays)),
    ):
        assert found.specular.shape == found.diffuse.shape == (*shape, 3)
        assert found.specular.dtype == dtype
        assert found.conditioned.shape == shape
        assert torch.isfinite(found.specular).all()


def rotated(mueller: np.ndarray, angle: float) -> np.ndarray:
    """An element turned counter-clockwise by ``angle`` radians."""
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    turn = np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]])
    return turn.T @ mueller @ turn


def polarizer(angle: float) -> np.ndarray:
    """An ideal linear polarizer whose axis lies at ``angle`` radians."""
    along = np.zeros((4, 4))
    along[:2, :2] = 0.5
    return rotated(along, angle)


def quarter_wave(angle: float, retardance: float = np.pi / 2) -> np.ndarray:
    """A retarder whose fast axis lies at ``angle`` radians."""
    c, s = np.cos(retardance), np.sin(retardance)
    return rotated(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]), angle)


def circular(angle: float, *, reversed_: bool, retardance: float = np.pi / 2) -> np.ndarray:
    """A CPL turned to ``angle``: light meets the polarizer first, then the plate at 45 degrees; or from behind."""
    parts = [polarizer(angle), quarter_wave(angle + np.pi / 4, retardance)]
    first, second = reversed(parts) if reversed_ else parts
    return np.asarray(second @ first)


def seen(stokes: np.ndarray, **how: object) -> np.ndarray:
    """Brightness at the four angles of the filter."""
    return np.array([(circular(np.radians(angle), **how) @ stokes)[0] for angle in ANGLES])  # type: ignore[arg-type]


@pytest.mark.parametrize("aolp", np.radians([0.0, 20.0, 67.0, 110.0, 155.0]))
@pytest.mark.parametrize("dolp", [0.1, 0.6, 1.0])
def test_mounted_the_ordinary_way_it_follows_malus(aolp: float, dolp: float) -> None:
    stokes = np.array([0.8, 0.8 * dolp * np.cos(2 * aolp), 0.8 * dolp * np.sin(2 * aolp), 0.0])
    expected = [malus(stokes[:3], np.radians(angle)) for angle in ANGLES]
    np.testing.assert_allclose(seen(stokes, reversed_=False), expected, atol=1e-12)
    # The plate behind the polarizer cannot change the brightness, whatever its color or quality.
    np.testing.assert_allclose(seen(stokes, reversed_=False, retardance=1.1), expected, atol=1e-12)


@pytest.mark.parametrize("aolp", np.radians([0.0, 20.0, 67.0, 110.0, 155.0]))
def test_reversed_it_gives_no_modulation(aolp: float) -> None:
    stokes = np.array([0.8, 0.8 * np.cos(2 * aolp), 0.8 * np.sin(2 * aolp), 0.0])
    np.testing.assert_allclose(seen(stokes, reversed_=True), 0.4, atol=1e-12)


def test_before_a_screen_only_the_analyzing_side_goes_dark() -> None:
    screen = np.array([1.0, 0.0, 1.0, 0.0])  # linear at 45 degrees, as most are
    turns = np.radians(np.arange(180))
    for reversed_, darkest in ((False, 0.0), (True, 0.5)):
        least = min((circular(turn, reversed_=reversed_) @ screen)[0] for turn in turns)
        assert least == pytest.approx(darkest, abs=1e-12)
