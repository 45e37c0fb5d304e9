"""The native kernels against the reference implementation, on every instruction set; always the same bits."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from raster_scenes import Outcome, differences, in_view, outcome, posed, same_bits
from reference_rasterizer import rasterize_reference

from polarguide import _native
from polarguide.raster import Splats, choose_backend, cpu
from polarguide.raster.cpu import native_rasterizer, rasterize_cpu

# Float32 against float64. Sums over some hundred pixels and some ten layers round off about 1e-6.
TOLERANCE = 1e-5
# A lone pixel's pull is summed about the tile's center, eight pixels away: nothing averages the rounding out.
LONE_PIXEL_TOLERANCE = 1e-4
CHANNELS = (1, 3, 4, 5, 7, 8, 11, 12, 16, 20, 32)
# The last two have several groups of tiles side by side, and one above the other.
SIZES = ((1, 1), (3, 2), (16, 16), (17, 33), (31, 18), (50, 37), (150, 20), (100, 75))
STATISTICS = (None, (0, 1, 2), (1, 4), (2,))


@pytest.fixture
def threads() -> Iterator[None]:
    before = _native.thread_count()
    yield
    _native.set_thread_count(before)


def compared(gaussians: Splats, width: int, height: int, statistic: tuple[int, ...] | None) -> None:
    camera = posed(width, height)
    found = outcome(rasterize_cpu, gaussians, camera, statistic)
    expected = outcome(rasterize_reference, gaussians, camera, statistic, dtype=torch.float64)
    assert torch.equal(found.radii > 0, expected.radii > 0)
    worst = differences(found, expected)
    assert max(worst.values()) < (TOLERANCE if width * height > 1 else LONE_PIXEL_TOLERANCE), worst
    touched = [float(g.norm()) > 0 for g in expected.gradients]
    assert all(touched), "the scene says nothing about some gradient"


@pytest.mark.parametrize("channels", CHANNELS)
def test_every_channel_count_agrees_with_the_reference(simd: str, channels: int) -> None:
    statistics = [s for s in STATISTICS if s is None or max(s) < channels]
    for seed, statistic in enumerate(statistics):
        gaussians = in_view(posed(23, 21), 40, channels, seed)
        compared(gaussians, 23, 21, statistic)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_every_picture_size_agrees_with_the_reference(simd: str, width: int, height: int) -> None:
    gaussians = in_view(posed(width, height), 60, 7, seed=11)
    compared(gaussians, width, height, (0, 1, 2))


@pytest.mark.parametrize("statistic", STATISTICS)
def test_statistic_counts_its_own_channels_alone(statistic: tuple[int, ...] | None) -> None:
    camera = posed(20, 20)
    gaussians = in_view(camera, 30, 7, seed=5)
    first = outcome(rasterize_cpu, gaussians, camera, statistic)
    other = gaussians.features.clone()
    ignored = [k for k in range(7) if statistic is None or k not in statistic]
    other[:, ignored] *= -3
    second = outcome(rasterize_cpu, gaussians._replace(features=other), camera, statistic)
    assert not torch.allclose(first.gradients.means, second.gradients.means)
    if statistic is None:
        assert first.statistic is None
    else:
        torch.testing.assert_close(first.statistic, second.statistic, rtol=1e-4, atol=1e-5)


def test_statistic_does_not_change_the_gradients() -> None:
    camera = posed(20, 20)
    gaussians = in_view(camera, 30, 7, seed=6)
    plain = outcome(rasterize_cpu, gaussians, camera)
    for channels in ((0, 1, 2), (1, 4), tuple(range(7)), ()):
        watched = outcome(rasterize_cpu, gaussians, camera, channels)
        worst = differences(watched._replace(statistic=None), plain)
        assert max(worst.values()) < TOLERANCE, (channels, worst)


def runs(gaussians: Splats, thread_counts: tuple[int, ...]) -> list[Outcome]:
    results = []
    for count in thread_counts:
        _native.set_thread_count(count)
        assert _native.thread_count() == count
        results.append(outcome(rasterize_cpu, gaussians, posed(70, 45), (0, 1, 2)))
    return results


@pytest.mark.usefixtures("threads")
def test_same_bits_for_any_number_of_threads(simd: str) -> None:
    # More Gaussians than a chunk of the projection, so that several threads really share each loop.
    small = in_view(posed(70, 45), 60, 7, seed=1)
    many = Splats(*(torch.cat([t] * 40) for t in small))
    jitter = torch.randn(many.means.shape, generator=torch.Generator().manual_seed(0))
    many = many._replace(means=many.means + 0.3 * jitter, opacities=many.opacities * 0.2)
    first, *others = runs(many, (1, 2, 3, 2, 1))
    assert all(same_bits(other, first) for other in others)


def test_same_bits_in_repeated_runs(simd: str) -> None:
    gaussians = in_view(posed(40, 30), 60, 8, seed=2)
    first, *others = (outcome(rasterize_cpu, gaussians, posed(40, 30), (1, 4)) for _ in range(4))
    assert all(same_bits(other, first) for other in others)


@pytest.mark.parametrize("culled", [1, 3, 4, 7, 8, 15, 16, 17])
def test_same_bits_wherever_in_a_vector_a_gaussian_is(simd: str, culled: int) -> None:
    camera = posed(30, 20)
    gaussians = in_view(camera, 37, 4, seed=8)
    expected = outcome(rasterize_cpu, gaussians, camera, (0,))
    # Some behind the camera, one in its center, and one without extent or direction.
    ahead = torch.cat((-gaussians.means[: culled - 1], -(camera.translation @ camera.rotation)[None].float()))
    rotations, scales = gaussians.rotations[:culled].clone(), gaussians.scales[:culled].clone()
    rotations[0], scales[0] = 0, 0
    others = Splats(ahead, rotations, scales, gaussians.opacities[:culled], gaussians.features[:culled])
    both = Splats(*(torch.cat(pair) for pair in zip(others, gaussians, strict=True)))
    found = outcome(rasterize_cpu, both, camera, (0,))
    assert not found.radii[:culled].any()
    assert not any(gradient[:culled].any() for gradient in found.gradients)
    shifted = Splats(*(gradient[culled:] for gradient in found.gradients))
    found = found._replace(radii=found.radii[culled:], gradients=shifted, statistic=found.statistic[culled:])
    assert same_bits(found, expected)


def test_a_picture_without_gradients_has_the_same_bits_and_nothing_to_go_back_to(simd: str) -> None:
    camera = posed(40, 30)
    gaussians = in_view(camera, 60, 7, seed=4)
    expected = outcome(rasterize_cpu, gaussians, camera)
    plain = rasterize_cpu(gaussians, camera)
    assert torch.equal(plain.features, expected.features)
    assert torch.equal(plain.alpha, expected.alpha)
    assert torch.equal(plain.radii, expected.radii)
    native = native_rasterizer(camera, 7, None)
    inputs, picture = list(gaussians), [torch.empty_like(t) for t in plain[:3]]
    arguments = (*inputs, plain.features, plain.features, plain.alpha, *map(torch.empty_like, inputs), None)
    for forward in (lambda: None, lambda: native.forward(*inputs, *picture, for_backward=False)):
        forward()
        with pytest.raises(ValueError, match="forward"):
            native.backward(*arguments)
    native.forward(*inputs, *picture)
    native.backward(*arguments)


def test_unknown_instruction_set_is_refused() -> None:
    active = _native.simd()
    with pytest.raises(ValueError, match="avx1024"):
        _native.select_simd("avx1024")
    assert _native.simd() == active


def test_auto_and_cpu_choose_the_native_backend() -> None:
    for name in ("auto", "cpu"):
        backend = choose_backend(name)
        assert backend.device == torch.device("cpu")
        assert backend.rasterize is rasterize_cpu


def test_gradients_follow_inputs_that_are_views_or_not_contiguous() -> None:
    camera = posed(16, 16)
    gaussians = in_view(camera, 20, 4, seed=3)
    expected = outcome(rasterize_cpu, gaussians, camera)
    wide = torch.cat((gaussians.features, torch.zeros_like(gaussians.features)), dim=1).requires_grad_()
    turned = gaussians.means.T.contiguous().requires_grad_()
    picture = rasterize_cpu(gaussians._replace(means=turned.T, features=wide[:, :4]), camera)
    assert torch.equal(picture.features, expected.features)
    generator = torch.Generator().manual_seed(7)
    to_features = torch.randn(picture.features.shape, generator=generator)
    to_alpha = torch.randn(picture.alpha.shape, generator=generator)
    ((picture.features * to_features).sum() + (picture.alpha * to_alpha).sum()).backward()
    torch.testing.assert_close(turned.grad.T, expected.gradients.means)
    torch.testing.assert_close(wide.grad[:, :4], expected.gradients.features)
    assert not wide.grad[:, 4:].any()


@pytest.mark.parametrize("records", [True, False], ids=["gradients", "none"])
def test_what_a_gradient_needs_is_kept_where_there_can_be_one(
    monkeypatch: pytest.MonkeyPatch, records: bool
) -> None:
    """Parameters say that they need a gradient even where none is recorded."""
    kept: list[bool] = []
    made: list[Any] = []

    class Watched:
        def __init__(self, *arguments: Any) -> None:
            made.append(native_rasterizer(*arguments))

        def forward(self, *arguments: Any, for_backward: bool) -> None:
            kept.append(for_backward)
            made[-1].forward(*arguments, for_backward=for_backward)

    monkeypatch.setattr(cpu, "native_rasterizer", Watched)
    camera = posed(20, 20)
    learned = Splats(*(t.requires_grad_() for t in in_view(camera, 10, 3, seed=0)))
    with torch.set_grad_enabled(records):
        picture = rasterize_cpu(learned, camera)
    assert kept == [records]
    assert picture.features.requires_grad == records
