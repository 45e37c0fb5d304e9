"""Channels once more, with a gradient on the features alone."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import differences, in_view, outcome, posed

from polarguide.raster.cpu import native_rasterizer, rasterize_cpu
from polarguide.raster.interface import Splats
from polarguide.raster.reference import rasterize_reference

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
