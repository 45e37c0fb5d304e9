"""Empty and extreme inputs, in both backends."""

import math

import pytest
import torch
from faults import Fault
from raster_scenes import (
    difference,
    differences,
    in_view,
    looking_ahead,
    outcome,
    posed,
    repeated,
    round_gaussian,
)
from reference_rasterizer import rasterize_reference

from polarguide.raster import Rasterize, ScreenStatistic, Splats, choose_backend
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.interface import BLUR

BOTH = pytest.mark.parametrize("rasterize", [rasterize_cpu, rasterize_reference], ids=["cpu", "reference"])


def finite(result: object) -> bool:
    features, alpha, radii, gradients, _ = result  # type: ignore[misc]
    return all(bool(torch.isfinite(t).all()) for t in (features, alpha, radii, *gradients))


@BOTH
def test_no_gaussians_give_an_empty_picture(rasterize: Rasterize) -> None:
    none = Splats(*(t[:0] for t in round_gaussian(1.0, 0.5)))
    result = outcome(rasterize, none, looking_ahead(20, 18), (0,))
    assert result.features.shape == (18, 20, 2)
    assert not result.features.any()
    assert not result.alpha.any()
    assert result.radii.shape == (0,)
    assert [t.shape for t in result.gradients] == [t.shape for t in none]
    assert result.statistic is None or result.statistic.shape == (0, 2)


@BOTH
def test_gaussians_behind_the_camera_are_culled(rasterize: Rasterize) -> None:
    camera = looking_ahead(20, 18)
    ahead = in_view(camera, 12, 3, seed=0)
    behind = ahead._replace(means=ahead.means * torch.tensor([1.0, 1.0, -1.0]))
    result = outcome(rasterize, behind, camera, (0, 1, 2))
    assert not result.features.any()
    assert not result.alpha.any()
    assert not result.radii.any()
    assert all(not gradient.any() for gradient in result.gradients)
    assert not result.statistic.any()


@BOTH
def test_gradients_are_zero_where_culled_and_right_elsewhere(rasterize: Rasterize) -> None:
    camera = looking_ahead(20, 18)
    ahead = in_view(camera, 12, 3, seed=0)
    alone = outcome(rasterize, ahead, camera, (0, 1, 2))
    behind = ahead._replace(means=ahead.means * torch.tensor([1.0, 1.0, -1.0]))
    mixed = Splats(*(torch.stack(pair, dim=1).flatten(0, 1) for pair in zip(behind, ahead, strict=True)))
    result = outcome(rasterize, mixed, camera, (0, 1, 2))
    torch.testing.assert_close(result.features, alone.features)
    for gradient, expected in zip(result.gradients, alone.gradients, strict=True):
        assert not gradient[0::2].any()
        torch.testing.assert_close(gradient[1::2], expected)
    assert not result.radii[0::2].any()


@BOTH
def test_opacity_below_the_cut_off_is_culled(rasterize: Rasterize) -> None:
    camera = looking_ahead(9, 9)
    below = outcome(rasterize, round_gaussian(1.0, 0.999 / 255), camera, (0,))
    assert not below.alpha.any()
    assert not below.radii.any()
    assert all(not gradient.any() for gradient in below.gradients)
    above = outcome(rasterize, round_gaussian(1.0, 1.02 / 255), camera, (0,))
    assert float(above.alpha.max()) > 0
    assert float(above.radii[0]) > 0


@BOTH
@pytest.mark.parametrize("sigma", [30.0, 1e3, 1e5])
def test_a_gaussian_that_covers_the_picture(rasterize: Rasterize, sigma: float) -> None:
    camera = looking_ahead(37, 21)
    result = outcome(rasterize, round_gaussian(sigma, 0.7), camera, (0, 1))
    assert finite(result)
    assert 0.68 < float(result.alpha.min()) <= float(result.alpha.max()) <= 0.7 + 1e-6
    reference = outcome(rasterize_reference, round_gaussian(sigma, 0.7), camera, dtype=torch.float64)
    assert difference(result.features, reference.features) < 1e-5
    assert difference(result.gradients.features, reference.gradients.features) < 1e-5


@pytest.mark.parametrize("size", [1e9, 1e15, 1e30])
def test_scales_beyond_what_float32_can_square_do_not_break_the_picture(size: float) -> None:
    camera = looking_ahead(20, 20)
    good = in_view(camera, 10, 2, seed=1)
    huge = round_gaussian(size, 0.5)
    result = outcome(rasterize_cpu, Splats(*(torch.cat(p) for p in zip(good, huge, strict=True))), camera)
    assert finite(result)
    assert 0 <= float(result.alpha.min()) <= float(result.alpha.max()) <= 1


@BOTH
def test_a_picture_of_one_pixel(rasterize: Rasterize) -> None:
    result = outcome(rasterize, round_gaussian(2.0, 0.6), looking_ahead(1, 1), (0, 1))
    assert result.features.shape == (1, 1, 2)
    assert float(result.alpha) == pytest.approx(0.6, abs=1e-6)
    torch.testing.assert_close(result.features[0, 0], torch.full((2,), 0.6))


@pytest.mark.parametrize("count", [50, 2000])
def test_a_stack_of_opaque_gaussians_ends_early(count: int) -> None:
    """Two show, the third would leave less than 1e-4: from it on there is no gradient, and none is NaN."""
    camera = looking_ahead(18, 18)
    depth = torch.linspace(2, 9, count)
    features = torch.randn(count, 2, generator=torch.Generator().manual_seed(0))
    stack = repeated(round_gaussian(1.0, 0.98), count)._replace(
        means=torch.stack((0 * depth, 0 * depth, depth), 1),
        scales=40 * depth[:, None].repeat(1, 3),
        features=features,
    )
    result = outcome(rasterize_cpu, stack, camera, (0, 1))
    assert finite(result)
    assert result.statistic is not None
    torch.testing.assert_close(result.alpha, torch.full((18, 18), 1 - 0.02**2), atol=1e-5, rtol=0)
    shown = (0.98 * features[0] + 0.02 * 0.98 * features[1]).expand(18, 18, 2)
    torch.testing.assert_close(result.features, shown, atol=1e-4, rtol=1e-4)
    assert all(bool(gradient[:2].any()) for gradient in (result.gradients.features, result.statistic))
    assert all(not gradient[2:].any() for gradient in (*result.gradients, result.statistic))


def test_early_ends_agree_with_the_reference() -> None:
    camera = posed(30, 26)
    gaussians = in_view(camera, 150, 4, seed=21)
    gaussians = gaussians._replace(opacities=gaussians.opacities.clamp(min=0.8, max=0.97))
    found = outcome(rasterize_cpu, gaussians, camera, (0, 1, 2))
    expected = outcome(rasterize_reference, gaussians, camera, (0, 1, 2), dtype=torch.float64)
    assert float(expected.alpha.max()) > 0.9995, "no pixel ends early"
    # A pixel whose transmittance lies within rounding of the end may end one Gaussian apart.
    same = (found.alpha - expected.alpha).abs() < 1e-6
    assert float(same.float().mean()) > 0.99
    assert difference(found.features[same], expected.features[same]) < 1e-5
    assert max(differences(found, expected).values()) < 1e-3


@pytest.mark.parametrize("thickness", [0.0, 1e-3])
@pytest.mark.parametrize("length", [3.0, 20.0])
def test_needles_and_discs(length: float, thickness: float) -> None:
    """Shapes whose covariance is singular but for the blur; the conic cancels, so the tolerance is wider."""
    camera = looking_ahead(40, 30)
    gaussians = in_view(camera, 30, 3, seed=4)
    pixel = gaussians.means[:, 2:] / camera.fx
    needle = torch.tensor([length, thickness, thickness])
    disc = torch.tensor([length, length, thickness])
    shapes = torch.where((torch.arange(30) % 2 == 0)[:, None], needle, disc)
    gaussians = gaussians._replace(scales=pixel * shapes)
    found = outcome(rasterize_cpu, gaussians, camera, (0, 1, 2))
    expected = outcome(rasterize_reference, gaussians, camera, (0, 1, 2), dtype=torch.float64)
    assert finite(found)
    worst = differences(found, expected)
    assert max(worst["features"], worst["alpha"], worst["radii"], worst["gradient of features"]) < 1e-4, worst
    assert max(worst.values()) < 5e-3, worst


def test_zero_quaternions_and_zero_scales_are_points() -> None:
    camera = looking_ahead(20, 20)
    gaussians = in_view(camera, 15, 3, seed=9)
    for changed in (
        gaussians._replace(rotations=0 * gaussians.rotations),
        gaussians._replace(scales=0 * gaussians.scales),
    ):
        found = outcome(rasterize_cpu, changed, camera)
        expected = outcome(rasterize_reference, changed, camera, dtype=torch.float64)
        assert finite(found)
        worst = differences(found, expected)
        assert max(worst["features"], worst["alpha"], worst["gradient of means"]) < 1e-5, worst


def test_gaussians_across_the_near_plane() -> None:
    """Means around the near plane, far off the axis: what is in front is drawn, the rest is culled."""
    camera = looking_ahead(24, 24)
    depth = torch.tensor([-0.5, 0.0, 0.005, 0.00999, 0.0101, 0.02, 0.1, 0.5])
    count = len(depth)
    gaussians = Splats(
        torch.stack((torch.linspace(-0.5, 0.5, count), 0.1 * torch.ones(count), depth), dim=1),
        torch.randn(count, 4, generator=torch.Generator().manual_seed(1)),
        torch.full((count, 3), 0.2),
        torch.full((count,), 0.4),
        torch.randn(count, 3, generator=torch.Generator().manual_seed(2)),
    )
    found = outcome(rasterize_cpu, gaussians, camera, (0, 1, 2))
    expected = outcome(rasterize_reference, gaussians, camera, (0, 1, 2), dtype=torch.float64)
    assert finite(found)
    assert not found.radii[depth <= 0.01].any()
    assert all(not gradient[depth <= 0.01].any() for gradient in found.gradients)
    assert bool((found.radii[depth > 0.09] > 0).all())
    assert torch.equal(found.radii > 0, expected.radii > 0)
    worst = differences(found, expected)
    assert max(worst["features"], worst["alpha"], worst["gradient of features"]) < 1e-4, worst


@pytest.mark.parametrize("nearest", [1.0, 0.011], ids=["less than 256 times", "10,000 times"])
def test_depths_of_any_range_are_in_order(nearest: float) -> None:
    """Depths are sorted by digits of their bits, of which a range beyond 256 needs one more."""
    count, generator = 300, torch.Generator().manual_seed(4)
    depth = nearest * (110 / nearest) ** torch.rand(count, generator=generator)
    depth[:4] = torch.tensor([nearest, 110.0, 50.0, 50.0])  # of two at one depth the first is in front
    splats = Splats(
        torch.stack((torch.zeros(count), torch.zeros(count), depth), dim=1),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4),
        (0.2 * depth)[:, None].expand(count, 3),  # all as large in the picture
        torch.full((count,), 0.02),
        torch.randn(count, 3, generator=generator),
    )
    camera = looking_ahead(17, 16)
    found = outcome(rasterize_cpu, splats, camera)
    expected = outcome(rasterize_reference, splats, camera, dtype=torch.float64)
    assert differences(found, expected)["features"] < 1e-5
    assert differences(found, expected)["gradient of features"] < 1e-5
    swapped = splats._replace(means=splats.means.flip(0), scales=splats.scales.flip(0))
    assert difference(outcome(rasterize_cpu, swapped, camera).features, expected.features) > 0.01


@BOTH
def test_radii_are_zero_outside_the_picture_and_three_sigma_inside(rasterize: Rasterize) -> None:
    camera = looking_ahead(20, 20, focal=100.0)
    inside = round_gaussian(0.15, 0.5)
    outside = inside._replace(means=torch.tensor([[9.0, 0.0, 3.0]]))
    pair = Splats(*(torch.cat(p) for p in zip(inside, outside, strict=True)))
    radii = rasterize(pair, camera).radii
    assert float(radii[1]) == 0
    # 5 pixels of spread and the blur; the definition adds a little under the root to round ellipses.
    variance = (100 / 3 * 0.15) ** 2 + BLUR
    assert float(radii[0]) == pytest.approx(3 * math.sqrt(variance + math.sqrt(0.1)), rel=1e-4)


@BOTH
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", Splats._fields)
def test_what_is_not_finite_is_refused_with_its_index(rasterize: Rasterize, name: str, value: float) -> None:
    camera = looking_ahead(8, 8)
    for index in (0, 3, 5):
        gaussians = repeated(round_gaussian(1.0, 0.5), 6)
        broken = getattr(gaussians, name).clone()
        broken.view(6, -1)[index, -1] = value
        fault = Fault(f"rasterize({name})", "finite", f"Gaussian {index}")
        fault.raised_by(rasterize, gaussians._replace(**{name: broken}), camera)


@BOTH
@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (6, 2)),
        ("means", ()),
        ("means", (5, 3)),
        ("rotations", (6, 3)),
        ("rotations", (5, 4)),
        ("scales", (6,)),
        ("scales", (7, 3)),
        ("opacities", (6, 1)),
        ("opacities", (1,)),
        ("features", (6,)),
        ("features", (5, 3)),
        ("features", (6, 3, 1)),
    ],
)
def test_wrong_shapes_are_refused(rasterize: Rasterize, name: str, shape: tuple[int, ...]) -> None:
    gaussians = repeated(round_gaussian(1.0, 0.5), 6)
    fault = Fault("rasterize(", "shape")
    fault.raised_by(rasterize, gaussians._replace(**{name: torch.ones(shape)}), looking_ahead(8, 8))


@BOTH
@pytest.mark.parametrize("channels", [0, 33, 100])
def test_channels_beyond_the_interface_are_refused(rasterize: Rasterize, channels: int) -> None:
    gaussians = round_gaussian(1.0, 0.5)._replace(features=torch.ones(1, channels))
    Fault(expected="1 to 32", found=str(channels)).raised_by(rasterize, gaussians, looking_ahead(8, 8))


@BOTH
@pytest.mark.parametrize("channels", [(2,), (0, -1), (1, 1)])
def test_channels_that_there_are_not_are_refused(rasterize: Rasterize, channels: tuple[int, ...]) -> None:
    for name, given in (("statistic", ScreenStatistic(channels)), ("still", channels)):
        Fault(name).raised_by(rasterize, round_gaussian(1.0, 0.5), looking_ahead(8, 8), **{name: given})


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.int64])
def test_native_backend_refuses_other_number_types(dtype: torch.dtype) -> None:
    gaussians = round_gaussian(1.0, 0.5)
    for name in Splats._fields:
        other = gaussians._replace(**{name: getattr(gaussians, name).to(dtype)})
        Fault(f"rasterize({name})", "float32").raised_by(rasterize_cpu, other, looking_ahead(8, 8))


def test_cuda_is_refused_with_a_remedy() -> None:
    Fault("--device cuda", remedy="--device cpu").raised_by(choose_backend, "cuda")
