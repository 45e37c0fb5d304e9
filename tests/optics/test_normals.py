"""Frames and normals: angles there and back, candidates, and the choice among them."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from polarguide import optics

coordinate = st.floats(-1.5, 1.5)
shapes = st.lists(st.integers(0, 3), max_size=3).map(tuple)


def ray(x: float, y: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor((x, y, 1.0), dtype=torch.float64), dim=0)


def rolled(angle: float) -> torch.Tensor:
    """Rotation about the optical axis that turns image right toward image down."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=torch.float64)


def test_axes_on_the_optical_axis() -> None:
    right, up = optics.lens_frame(ray(0, 0))
    assert right.tolist() == [1, 0, 0]
    assert up.tolist() == [0, -1, 0]


@given(x=coordinate, y=coordinate)
def test_frame_is_right_handed_and_orthonormal(x: float, y: float) -> None:
    d = ray(x, y)
    right, up = optics.lens_frame(d)
    frame = torch.stack((right, up, -d))
    assert torch.allclose(frame @ frame.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert float(torch.det(frame)) == pytest.approx(1.0, abs=1e-14)


@given(x=st.floats(0.05, 1.5), y=coordinate)
def test_frame_is_the_smallest_rotation_from_the_axis(x: float, y: float) -> None:
    d = ray(x, y)
    forward = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    axis = torch.nn.functional.normalize(torch.linalg.cross(forward, d), dim=0)
    angle = math.acos(float(d[2]))
    for moved, at_center in zip(optics.lens_frame(d), ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)), strict=True):
        v = torch.tensor(at_center, dtype=torch.float64)
        turned = v * math.cos(angle) + torch.linalg.cross(axis, v) * math.sin(angle)
        turned = turned + axis * (axis @ v) * (1 - math.cos(angle))
        assert torch.allclose(moved, turned, atol=1e-12)


@given(x=coordinate, y=coordinate, polar=st.floats(0.01, math.pi - 0.01), turn=st.floats(-math.pi, math.pi))
def test_zenith_and_azimuth_round_trip(x: float, y: float, polar: float, turn: float) -> None:
    d = ray(x, y)
    angles = torch.tensor((polar, turn), dtype=torch.float64)
    normal = optics.normal_from_angles(angles[0], angles[1], d)
    assert float(normal.norm()) == pytest.approx(1.0, abs=1e-13)
    assert float(optics.zenith(normal, d)) == pytest.approx(polar, abs=1e-12)
    assert math.remainder(float(optics.azimuth(3 * normal, d)) - turn, 2 * math.pi) == pytest.approx(
        0, abs=1e-11
    )
    assert float(-normal @ d) == pytest.approx(math.cos(polar), abs=1e-13)


@given(x=coordinate, y=coordinate, roll=st.floats(-3, 3))
def test_azimuth_turns_with_the_camera_and_zenith_does_not(x: float, y: float, roll: float) -> None:
    turn = rolled(roll)
    d = ray(x, y)
    normal = optics.normal_from_angles(
        torch.tensor(0.7, dtype=torch.float64), torch.tensor(1.1, dtype=torch.float64), d
    )
    seen, toward = turn @ normal, turn @ d
    assert float(optics.zenith(seen, toward)) == pytest.approx(0.7, abs=1e-12)
    # Right turns toward down, which is clockwise as displayed, so azimuths shrink.
    difference = float(optics.azimuth(seen, toward)) - (1.1 - roll)
    assert math.remainder(difference, 2 * math.pi) == pytest.approx(0, abs=1e-11)


def test_azimuth_is_counter_clockwise_as_displayed() -> None:
    up = torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64)
    assert float(optics.azimuth(up, ray(0, 0))) == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("z", [1.0, -1.0])
def test_gradient_is_finite_where_the_normal_has_no_azimuth(z: float, dtype: torch.dtype) -> None:
    for vector in ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)):
        normal = torch.tensor(vector, dtype=dtype, requires_grad=True)
        rays = torch.tensor((0.0, 0.0, z), dtype=dtype, requires_grad=True)
        total = optics.zenith(normal, rays) + optics.azimuth(normal, rays)
        total = total + optics.lens_frame(rays)[0].sum() + optics.lens_frame(rays)[1].sum()
        total.backward()
        assert torch.isfinite(total)
        assert torch.isfinite(normal.grad).all()
        assert torch.isfinite(rays.grad).all()


def test_zenith_at_normal_incidence_is_exact() -> None:
    d = ray(0.4, -0.3)
    assert float(optics.zenith(-d, d)) < 1e-15
    assert float(optics.zenith(d, d)) == pytest.approx(math.pi, abs=1e-15)


@given(shape=shapes, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    rays = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=dtype), dim=-1)
    polar, turn = torch.rand(shape, dtype=dtype), torch.rand(shape, dtype=dtype)
    normals = optics.normal_from_angles(polar, turn, rays)
    assert normals.shape == (*shape, 3)
    assert normals.dtype == dtype
    assert optics.zenith(normals, rays).shape == shape
    assert torch.allclose(optics.zenith(normals, rays), polar, atol=1e-4)


F64 = torch.float64


def surface(zenith: float, azimuth: float, *, specular: bool, index: float = 1.5) -> tuple[torch.Tensor, ...]:
    """(Luminance Stokes vector, normal, ray) of one pixel of a pure lobe, off the optical axis."""
    ray = torch.nn.functional.normalize(torch.tensor((0.3, -0.2, 1.0), dtype=F64), dim=0)
    normal = optics.normal_from_angles(torch.tensor(zenith, dtype=F64), torch.tensor(azimuth, dtype=F64), ray)
    on, off = torch.ones(3, dtype=F64), torch.zeros(3, dtype=F64)
    light = optics.predicted_stokes(on if specular else off, off if specular else on, normal, ray, index)
    return optics.luminance(light), normal, ray


@given(zenith=st.floats(0.05, 1.5), azimuth=st.floats(0, 2 * math.pi), specular=st.booleans())
def test_a_pure_lobe_has_its_normal_among_the_six(zenith: float, azimuth: float, specular: bool) -> None:
    light, normal, ray = surface(zenith, azimuth, specular=specular)
    candidates = optics.physical_candidates(light, ray)
    chosen = optics.disambiguate(candidates, normal)
    assert float(chosen.cosine) > 1 - 1e-9
    assert torch.allclose(chosen.normal, normal, atol=1e-5)
    assert bool(candidates.valid[chosen.choice])


@given(zenith=st.floats(0.05, 1.5), azimuth=st.floats(0, 2 * math.pi))
def test_a_diffuse_normal_or_its_half_turn_is_the_papers_first(zenith: float, azimuth: float) -> None:
    light, normal, ray = surface(zenith, azimuth, specular=False)
    candidates = optics.paper_candidates(light, ray)
    assert float(candidates.zenith) == pytest.approx(zenith, abs=1e-9)
    half_turn = optics.normal_from_angles(candidates.zenith, candidates.azimuth + math.pi, ray)
    best = torch.stack((candidates.normals[0], half_turn)) @ normal
    assert float(best.max()) > 1 - 1e-9


def test_paper_candidates_are_two_opposite_pairs_a_quarter_turn_apart() -> None:
    light, _, ray = surface(0.8, 0.5, specular=False)
    normals = optics.paper_candidates(light, ray).normals
    assert torch.allclose(normals[1], -normals[0])
    assert torch.allclose(normals[3], -normals[2])
    assert ((normals @ -ray) > 0).tolist() == [True, False, True, False]
    turn = optics.azimuth(normals[2], ray) - optics.azimuth(normals[0], ray)
    assert math.remainder(float(turn), 2 * math.pi) == pytest.approx(math.pi / 2)


def test_a_half_turn_defeats_the_papers_candidates() -> None:
    # The normal is n turned by pi about the ray: -n faces away, and the quarter turns are off by far.
    light, _, ray = surface(0.8, 0.5, specular=False)
    four = optics.paper_candidates(light, ray)
    flipped = optics.normal_from_angles(four.zenith, four.azimuth + math.pi, ray)
    assert math.degrees(math.acos(float(optics.disambiguate(four, flipped).cosine))) > 55
    assert float(optics.disambiguate(optics.physical_candidates(light, ray), flipped).cosine) > 1 - 1e-9


@given(s1=st.floats(-0.7, 0.7), s2=st.floats(-0.7, 0.7))
def test_six_candidates_are_unit_and_face_the_camera(s1: float, s2: float) -> None:
    ray = torch.nn.functional.normalize(torch.tensor((-0.4, 0.1, 1.0), dtype=F64), dim=0)
    found = optics.physical_candidates(torch.tensor((1.0, s1, s2), dtype=F64), ray)
    assert found.normals.shape == (6, 3)
    assert torch.allclose(found.normals.norm(dim=-1), torch.ones(6, dtype=F64))
    assert ((found.normals @ -ray) > -1e-12).all()
    assert found.specular.tolist() == [False, False, True, True, True, True]


@pytest.mark.parametrize(("degree", "diffuse"), [(0.38, True), (0.39, False)])
def test_diffuse_candidates_end_at_the_diffuse_limit(degree: float, diffuse: bool) -> None:
    ray = torch.tensor((0.0, 0.0, 1.0), dtype=F64)
    light = torch.tensor((1.0, degree, 0.0), dtype=F64)
    assert optics.physical_candidates(light, ray).valid.tolist() == [diffuse, diffuse, True, True, True, True]
    assert not optics.physical_candidates(light * 0, ray).valid.any()


def test_invalid_candidates_are_not_chosen() -> None:
    ray = torch.tensor((0.0, 0.0, 1.0), dtype=F64)
    found = optics.physical_candidates(torch.tensor((1.0, 0.9, 0.0), dtype=F64), ray)
    # The clamped diffuse candidate lies at grazing along the azimuth AoLP = 0.
    guide = torch.tensor((1.0, 0.0, 0.0), dtype=F64)
    assert int(found.normals.matmul(guide).argmax()) == 0
    assert bool(found.specular[optics.disambiguate(found, guide).choice])


def test_azimuth_is_trusted_over_a_zenith_from_the_wrong_index() -> None:
    ray = torch.tensor((0.0, 0.0, 1.0), dtype=F64)
    angles = torch.tensor(((1.15, 0.0), (0.75, 0.6)), dtype=F64)
    candidates = optics.normal_from_angles(angles[:, 0], angles[:, 1], ray)
    guide = optics.normal_from_angles(torch.tensor(0.7, dtype=F64), torch.tensor(0.05, dtype=F64), ray)
    assert int(optics.disambiguate(candidates, guide).choice) == 1
    weighted = optics.disambiguate(candidates, guide, ray, azimuth_weight=0.9)
    assert int(weighted.choice) == 0
    assert float(weighted.cosine) == pytest.approx(float(candidates[0] @ guide))


@given(weight=st.floats(0, 1), turn=st.floats(-3, 3))
def test_choice_does_not_change_when_the_camera_rolls(weight: float, turn: float) -> None:
    c, s = math.cos(turn), math.sin(turn)
    roll = torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=F64)
    light, normal, ray = surface(0.9, 1.0, specular=True)
    guide = normal + torch.tensor((0.1, 0.05, -0.2), dtype=F64)
    candidates = optics.physical_candidates(light, ray)
    upright = optics.disambiguate(candidates, guide, ray, azimuth_weight=weight)
    turned = optics.disambiguate(
        candidates._replace(normals=candidates.normals @ roll.T),
        roll @ guide,
        roll @ ray,
        azimuth_weight=weight,
    )
    assert int(upright.choice) == int(turned.choice)


def test_azimuth_weight_needs_rays_and_a_range() -> None:
    candidates = torch.eye(3, dtype=F64)
    with pytest.raises(ValueError, match="rays"):
        optics.disambiguate(candidates, candidates[0], azimuth_weight=0.5)
    with pytest.raises(ValueError, match=r"1\.5"):
        optics.disambiguate(candidates, candidates[0], candidates[0], azimuth_weight=1.5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "light", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 2.0, 0.0), (-1.0, 0.1, 0.0)]
)
def test_gradient_is_finite_at_every_degenerate_pixel(light: tuple[float, ...], dtype: torch.dtype) -> None:
    ray = torch.tensor((0.0, 0.0, 1.0), dtype=dtype)
    for direction in ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)):
        leaf = torch.tensor(light, dtype=dtype, requires_grad=True)
        guide = torch.tensor(direction, dtype=dtype, requires_grad=True)
        four, six = optics.paper_candidates(leaf, ray), optics.physical_candidates(leaf, ray)
        chosen = optics.disambiguate(six, guide, ray, azimuth_weight=0.5)
        total = four.normals.sum() + six.normals.sum() + chosen.cosine + chosen.normal.sum()
        assert torch.isfinite(total)
        for gradient in torch.autograd.grad(total, (leaf, guide)):
            assert torch.isfinite(gradient).all()


@given(
    shape=st.lists(st.integers(0, 3), max_size=2).map(tuple),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_candidates_of_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    rays = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=dtype), dim=-1)
    light = torch.rand(3, *shape, dtype=dtype)
    four, six = optics.paper_candidates(light, rays), optics.physical_candidates(light, rays)
    assert four.normals.shape == (*shape, 4, 3)
    assert six.normals.shape == (*shape, 6, 3)
    assert six.valid.shape == (*shape, 6)
    chosen = optics.disambiguate(six, -rays, rays, azimuth_weight=0.5)
    assert chosen.normal.shape == (*shape, 3)
    assert chosen.choice.shape == chosen.cosine.shape == shape
    assert chosen.normal.dtype == dtype
    assert optics.polarization_mask(light).shape == shape


def test_mask_keeps_what_is_polarized_valid_and_unsaturated() -> None:
    light = torch.tensor(
        ((1.0, 1.0, 1.0, 1.0, 0.0, -1.0), (0.04, 0.06, 0.06, 0.06, 0.1, 0.5), (0.0,) * 6), dtype=F64
    )
    invalid = torch.tensor((False, False, True, False, False, False))
    saturated = torch.tensor((False, False, False, True, False, False))
    mask = optics.polarization_mask(light, invalid=invalid, saturated=saturated)
    assert mask.tolist() == [False, True, False, False, False, False]
    assert optics.polarization_mask(light, threshold=0.03).tolist() == [True] * 4 + [False] * 2


def test_noise_of_dolp_is_what_a_simulation_finds() -> None:
    generator = torch.Generator().manual_seed(3)
    sigma, count = 0.002, 200_000
    for degree in (0.2, 0.9):
        light = torch.tensor((0.5, 0.5 * degree * math.cos(0.8), 0.5 * degree * math.sin(0.8)), dtype=F64)
        images = torch.stack([optics.intensity(light, math.radians(a)) for a in optics.ANGLES])
        noise = torch.randn(4, count, generator=generator, dtype=F64) * sigma
        measured = optics.dolp(optics.stokes(images[:, None] + noise))
        assert float(optics.dolp_noise(light, sigma)) == pytest.approx(float(measured.std()), rel=0.01)


def test_noise_alone_rarely_passes_the_mask() -> None:
    generator = torch.Generator().manual_seed(4)
    images = 0.05 + torch.randn(4, 100_000, generator=generator, dtype=F64) * 0.005
    light = optics.stokes(images)
    scale = math.sqrt(2) * 0.005 / 0.1
    # The degree of polarization of pure noise is Rayleigh-distributed.
    rayleigh = math.exp(-0.5 * (0.05 / scale) ** 2)
    assert float(optics.polarization_mask(light).double().mean()) == pytest.approx(rayleigh, abs=0.01)
    passed = optics.polarization_mask(light, noise_sigma=0.005, snr=3.0)
    assert float(passed.double().mean()) == pytest.approx(math.exp(-4.5), abs=0.003)
    per_pixel = torch.full_like(light[0], 0.005)
    assert torch.equal(optics.polarization_mask(light, noise_sigma=per_pixel), passed)


def test_noise_without_light_is_infinite() -> None:
    light = torch.zeros(3, 2, dtype=F64)
    assert torch.isinf(optics.dolp_noise(light, 0.01)).all()


@pytest.mark.parametrize("sigma", [1e-3, 1e-2])
def test_noise_of_the_intensities_is_read_from_their_sums_whatever_the_gains(sigma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(3, 60, 80, generator=generator, dtype=torch.float64) * 0.3
    light[0] += 0.5
    clean = torch.stack([optics.intensity(light, math.radians(a)) for a in optics.ANGLES])
    noise = torch.randn(clean.shape, generator=generator, dtype=torch.float64) * sigma
    found = optics.intensity_noise(clean + noise)
    assert float((found / sigma - 1)[8:-8, 8:-8].abs().max()) < 0.3
    assert float(found.mean() / sigma) == pytest.approx(1, abs=0.03)
    gains = torch.tensor([1.0, 1.01, 0.99, 1.01], dtype=torch.float64)[:, None, None]
    flat = torch.stack([torch.full((60, 80), 0.4, dtype=torch.float64)] * 4)
    assert float(optics.intensity_noise(flat * gains).max()) < 1e-7
    with pytest.raises(ValueError, match="intensities"):
        optics.intensity_noise(clean[..., None])
    with pytest.raises(ValueError, match="window"):
        optics.intensity_noise(clean, window=4)
