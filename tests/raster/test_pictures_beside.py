"""The picture of a surface, held channels, and the weight in front of a depth: native against the reference."""

import pytest
import torch
from faults import Fault
from raster_scenes import differences, in_view, looking_ahead, outcome, posed, round_gaussian
from reference_rasterizer import rasterize_reference
from slow_surface import surface_reference

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.raster import Splats
from polarguide.raster.cpu import native_rasterizer, rasterize_cpu
from polarguide.raster.surface import SurfacePicture, alpha_in_front, surface_picture


def reference(splats: Splats, camera: Camera) -> SurfacePicture:
    return surface_reference(Splats(*(t.double() for t in splats)), camera, rasterize_reference)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (50, 37)])
def test_native_against_the_reference(simd: str, size: tuple[int, int]) -> None:
    camera = posed(*size)
    splats = in_view(camera, 90, 3, seed=5)
    found, true = surface_picture(splats, camera), reference(splats, camera)
    # Where the weights reach half of their sum within rounding, either of two Gaussians is the median.
    far = (found.depth - true.depth).abs() > 1e-4 * true.depth
    assert float(far.float().mean()) < 0.002
    torch.testing.assert_close(found.depth[~far].double(), true.depth[~far], rtol=1e-4, atol=0)
    torch.testing.assert_close(found.directions[~far].double(), true.directions[~far], rtol=0, atol=2e-3)
    assert float((found.directions[~far] - true.directions[~far]).abs().mean()) < 2e-5


def test_bits_do_not_depend_on_threads(simd: str) -> None:
    camera, before = posed(70, 50), _native.thread_count()
    splats = in_view(camera, 90, 3, seed=6)
    try:
        pictures = []
        for threads in (1, 3):
            _native.set_thread_count(threads)
            pictures.append(surface_picture(splats, camera))
    finally:
        _native.set_thread_count(before)
    assert torch.equal(pictures[0].directions, pictures[1].directions)
    assert torch.equal(pictures[0].depth, pictures[1].depth)


def layers(*depths_and_opacities: tuple[float, float]) -> tuple[Splats, Camera]:
    """Wide Gaussians one behind the other, each with a direction of its own."""
    parts = [round_gaussian(4.0, opacity, depth) for depth, opacity in depths_and_opacities]
    splats = Splats(*(torch.cat(values) for values in zip(*parts, strict=True)))
    return splats._replace(features=torch.eye(3)[: len(parts)]), looking_ahead(5, 5)


def test_of_two_surfaces_it_is_the_one_that_shows_more() -> None:
    for opacity, depth, axis in ((0.45, 6.0, 1), (0.6, 2.0, 0)):
        found = surface_picture(*layers((2.0, opacity), (6.0, 0.98)))
        assert float(found.depth[2, 2]) == pytest.approx(depth, rel=1e-6)
        assert found.directions[2, 2].tolist() == pytest.approx(torch.eye(3)[axis].tolist(), abs=1e-6)
        blended = rasterize_cpu(*layers((2.0, opacity), (6.0, 0.98))).features[2, 2]
        assert 0.3 < float(blended[0] / blended.sum()) < 0.7, "between them, where it is blended"


def test_neighbors_within_the_width_are_averaged() -> None:
    found = surface_picture(*layers((2.0, 0.5), (2.01, 0.9)))
    assert 2.0 < float(found.depth[2, 2]) < 2.01
    assert 0.4 < float(found.directions[2, 2, 0]) < 0.6


def test_where_nothing_is() -> None:
    splats, camera = layers((2.0, 0.9))
    nothing = surface_picture(Splats(*(t[:0] for t in splats)), camera)
    behind = surface_picture(splats._replace(means=-splats.means), camera)
    for found in (nothing, behind):
        assert float(found.depth.abs().max()) == 0
        assert float(found.directions.abs().max()) == 0


def test_a_value_that_is_not_finite_is_named() -> None:
    splats, camera = layers((2.0, 0.9), (3.0, 0.9))
    broken = splats.means.clone()
    broken[1, 0] = torch.nan
    Fault("rasterize(means)", "finite", "Gaussian 1").raised_by(
        surface_picture, splats._replace(means=broken), camera
    )


def test_what_the_kernel_refuses() -> None:
    splats, camera = layers((2.0, 0.9))
    out = torch.empty(5, 5, 4)
    four = splats._replace(features=torch.ones(1, 4))
    for given, width, picture, what in (
        (splats, 0.03, torch.empty(5, 5, 3), "channels"),
        (four, 0.0, out, "width"),
        (four, float("nan"), out, "width"),
        (four, 0.03, torch.empty(5, 4, 4), "out"),
    ):
        rasterizer = native_rasterizer(camera, given.features.shape[1], None)
        with pytest.raises(ValueError, match=what):
            rasterizer.surface(*given, width, picture)
    kept = native_rasterizer(camera, 4, None)
    kept.surface(*four, 0.03, out)
    pictures = [torch.zeros(5, 5, 4), torch.zeros(5, 5, 4), torch.zeros(5, 5)]
    with pytest.raises(ValueError, match="forward"):
        kept.backward(*four, *pictures, *(torch.empty_like(t) for t in four), None)


CAMERA = posed(37, 29)


@pytest.mark.parametrize("still", [(3, 4, 5), (6, 2), (0,)])
@pytest.mark.parametrize("statistic", [None, (0, 1, 2), (4, 1)])
@pytest.mark.parametrize("channels", [7, 11])
def test_gradients_as_in_the_reference(
    simd: str, still: tuple[int, ...], statistic: tuple[int, ...] | None, channels: int
) -> None:
    gaussians = in_view(CAMERA, 80, channels, seed=channels)
    found = outcome(rasterize_cpu, gaussians, CAMERA, statistic, still=still)
    expected = outcome(rasterize_reference, gaussians, CAMERA, statistic, still=still, dtype=torch.float64)
    assert max(differences(found, expected).values()) < 2e-5
    plain = outcome(rasterize_cpu, gaussians, CAMERA, statistic)
    for name in ("means", "rotations", "scales", "opacities"):
        assert torch.equal(getattr(found.gradients, name), getattr(plain.gradients, name)), "nothing moves"
    changed = (found.gradients.features != plain.gradients.features).any(dim=0)
    assert changed.nonzero().flatten().tolist() == sorted(still)
    if statistic is not None:
        assert torch.equal(found.statistic, plain.statistic)


def test_the_pictures_are_those_of_the_channels() -> None:
    gaussians = in_view(CAMERA, 50, 7, seed=1)
    picture = rasterize_cpu(gaussians, CAMERA, still=(5, 3))
    assert torch.equal(picture.still, picture.features[..., [5, 3]])
    assert rasterize_cpu(gaussians, CAMERA).still is None


def test_without_a_gradient_on_them_nothing_changes() -> None:
    gaussians = in_view(CAMERA, 50, 7, seed=1)
    both = []
    for still in ((), (3, 4, 5)):
        inputs = Splats(*(t.detach().clone().requires_grad_() for t in gaussians))
        rasterize_cpu(inputs, CAMERA, still=still).features.square().sum().backward()
        both.append(inputs)
    for a, b in zip(*both, strict=True):
        assert torch.equal(a.grad, b.grad)


@pytest.mark.parametrize(("still", "size"), [([7], 1), ([-1], 1), ([1, 1], 2), ([3, 4, 5], 2)])
def test_the_kernels_refuse_channels_that_do_not_fit(still: list[int], size: int) -> None:
    gaussians = in_view(CAMERA, 10, 7, seed=1)
    native = native_rasterizer(CAMERA, 7, None)
    inputs = [t.contiguous() for t in gaussians]
    out, alpha = torch.zeros(CAMERA.height, CAMERA.width, 7), torch.zeros(CAMERA.height, CAMERA.width)
    native.forward(*inputs, out, alpha, torch.zeros(10))
    gradients = [torch.empty_like(t) for t in inputs]
    to_still = torch.zeros(CAMERA.height, CAMERA.width, size)
    with pytest.raises(ValueError, match="still"):
        native.backward(*inputs, out, out, alpha, *gradients, None, still, to_still)


BEFORE = posed(20, 16)


@pytest.fixture
def splats() -> Splats:
    return in_view(BEFORE, 60, 1, seed=4)


def depths(splats: Splats) -> torch.Tensor:
    return (splats.means.double() - BEFORE.center) @ BEFORE.rotation[2]


def test_alpha_in_front_is_that_of_the_near_gaussians_alone(splats: Splats) -> None:
    generator = torch.Generator().manual_seed(1)
    places = depths(splats)
    low, high = float(places.min()), float(places.max())
    depth = low + (high - low) * torch.rand(BEFORE.height, BEFORE.width, generator=generator)
    depth[:, :5] = 0.0
    near = []
    for point, place in zip(splats.means.double(), places, strict=True):
        x, y, z = ((point - BEFORE.center) @ BEFORE.rotation.T).tolist()
        column, row = BEFORE.fx * x / z + BEFORE.cx, BEFORE.fy * y / z + BEFORE.cy
        inside = 0 <= column < BEFORE.width and 0 <= row < BEFORE.height
        near.append(inside and float(place) < float(depth[int(row), int(column)]))
    assert 10 < sum(near) < len(near) - 10
    expected = rasterize_reference(Splats(*(t[torch.tensor(near)] for t in splats)), BEFORE).alpha
    got = alpha_in_front(splats, BEFORE, depth, rasterize_cpu)
    torch.testing.assert_close(got, expected, atol=1e-4, rtol=0)


def test_alpha_in_front_without_a_depth_or_a_gaussian_is_zero(splats: Splats) -> None:
    size = (BEFORE.height, BEFORE.width)
    assert float(alpha_in_front(splats, BEFORE, torch.zeros(size), rasterize_cpu).max()) == 0
    nothing = Splats(*(t[:0] for t in splats))
    assert float(alpha_in_front(nothing, BEFORE, torch.ones(size), rasterize_cpu).max()) == 0
