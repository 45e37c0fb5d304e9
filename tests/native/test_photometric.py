"""The photometric loss: kernel and reference implementation against scikit-image and finite differences; sRGB."""

import math
from typing import Any

import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.optics.color import srgb_decode, srgb_encode
from polarguide.training.photometric import (
    ExplicitPhotometric,
    photometric_loss,
    photometric_terms,
    photometric_terms_reference,
)

sizes = pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 40), (40, 1), (3, 5), (7, 16), (12, 11), (33, 47), (64, 53)]
)


def explicit_loss(*given: Any) -> Tensor:
    """``photometric_loss`` as other devices than the CPU compute it."""
    return ExplicitPhotometric.apply(*given)[0]


def reference_loss(*given: Any) -> Tensor:
    """``photometric_loss`` in plain PyTorch."""
    return photometric_terms_reference(*given).loss


def pictures(height: int, width: int, low: float = -0.1, high: float = 1.1) -> tuple[Tensor, Tensor]:
    """A linear prediction, in part out of range, and a shown target that resembles it."""
    generator = torch.Generator().manual_seed(height * 1000 + width)
    prediction = low + (high - low) * torch.rand(height, width, 3, generator=generator)
    noise = 0.1 * torch.randn(height, width, 3, generator=generator)
    return prediction, (srgb_encode(prediction.clamp(0, 1)) + noise).clamp(0, 1)


def some_weights(height: int, width: int) -> Tensor:
    return (torch.rand(height, width, generator=torch.Generator().manual_seed(1)) > 0.3).float()


def loss_and_gradient(function, prediction: Tensor, *rest) -> tuple[Tensor, Tensor]:
    leaf = prediction.detach().clone().requires_grad_()
    loss = function(leaf, *rest)
    (gradient,) = torch.autograd.grad(3 * loss, leaf)
    return loss.detach(), gradient


def relative_error(found: Tensor, exact: Tensor) -> float:
    return float((found.double() - exact).norm() / exact.norm().clamp(min=1e-12))


@sizes
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_kernel_agrees_with_the_reference(
    simd: str, height: int, width: int, weighted: bool, ssim_weight: float
) -> None:
    prediction, target = pictures(height, width)
    weight = some_weights(height, width) if weighted else None
    found = loss_and_gradient(photometric_loss, prediction, target, weight, ssim_weight)
    exact = loss_and_gradient(
        reference_loss,
        prediction.double(),
        target.double(),
        None if weight is None else weight.double(),
        ssim_weight,
    )
    assert_close(found[0].double(), exact[0], rtol=1e-5, atol=1e-6)
    assert relative_error(found[1], exact[1]) < 1e-4


@sizes
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_the_written_out_gradient_is_that_of_the_reference(
    height: int, width: int, weighted: bool, ssim_weight: float
) -> None:
    """What other devices compute."""
    prediction, target = (t.double() for t in pictures(height, width))
    weight = some_weights(height, width).double() if weighted else None
    found = loss_and_gradient(
        lambda *given: ExplicitPhotometric.apply(*given)[0], prediction, target, weight, ssim_weight
    )
    exact = loss_and_gradient(reference_loss, prediction, target, weight, ssim_weight)
    assert_close(found[0], exact[0])
    assert relative_error(found[1], exact[1]) < 1e-9


def test_smooth_pictures_agree_too(simd: str) -> None:
    """Small variances, where E[xx] - E[x]^2 loses digits in float32. (SSIM alone: L1 may tie, and jump.)"""
    ramp = torch.linspace(0.2, 0.7, 60)[:, None, None].expand(60, 70, 3).contiguous()
    noise = torch.randn(60, 70, 3, generator=torch.Generator().manual_seed(0))
    target = (srgb_encode(ramp) + 0.003 * noise).clamp(0, 1)
    found = loss_and_gradient(photometric_loss, ramp, target, None, 1.0)
    exact = loss_and_gradient(reference_loss, ramp.double(), target.double(), None, 1.0)
    assert_close(found[0].double(), exact[0], rtol=0, atol=2e-5)
    assert relative_error(found[1], exact[1]) < 2e-4


@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_of_the_reference(weighted: bool) -> None:
    prediction, target = pictures(6, 7, low=0.05, high=0.95)
    weight = some_weights(6, 7).double() if weighted else None
    torch.autograd.gradcheck(
        lambda p: reference_loss(p, target.double(), weight), prediction.double().requires_grad_()
    )


def test_ssim_agrees_with_scikit_image(simd: str) -> None:
    """Away from the border, where scikit-image mirrors the picture and the loss pads with zeros."""
    prediction, target = pictures(40, 50)
    shown = srgb_encode(prediction.double().clamp(0, 1))
    _, values = structural_similarity(
        shown.numpy(),
        target.double().numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    interior = torch.zeros(40, 50)
    interior[5:-5, 5:-5] = 1
    expected = 1 - values[5:-5, 5:-5].mean()
    assert float(photometric_loss(prediction, target, interior, 1.0)) == pytest.approx(expected, rel=2e-5)
    reference = reference_loss(prediction.double(), target.double(), interior.double(), 1.0)
    assert float(reference) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("weighted", [False, True])
def test_squared_difference_as_shown(simd: str, weighted: bool) -> None:
    prediction, target = pictures(33, 47)
    weight = some_weights(33, 47) if weighted else None
    found = photometric_terms(prediction, target, weight)
    reference = photometric_terms_reference(
        prediction.double(), target.double(), None if weight is None else weight.double()
    )
    squares = (srgb_encode(prediction.double().clamp(0, 1)) - target.double()).square().numpy()
    expected = squares[weight.numpy() > 0].mean() if weight is not None else squares.mean()
    assert float(found.error) == pytest.approx(float(expected), rel=2e-6)
    assert float(reference.error) == pytest.approx(float(expected), rel=1e-9)
    assert torch.equal(found.loss, photometric_loss(prediction, target, weight))
    assert float(photometric_terms(prediction, target, torch.zeros(33, 47)).error) == 0


def exact_srgb(value: float) -> float:
    return 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055


def test_kernel_srgb_is_exact_to_a_millionth(simd: str) -> None:
    """One pixel against black: the L1 term is the mean of the shown values."""
    values = [0.0, 1e-30, 1e-5, 0.0031307, 0.0031309, 1.0, 1.5, *torch.linspace(0.004, 1, 400).tolist()]
    for value in values:
        l1, *_ = _native.photometric(torch.full((1, 1, 3), value), torch.zeros(1, 1, 3), None, 1.0, 0.2, None)
        exact = exact_srgb(min(float(torch.tensor(value)), 1.0))
        assert l1 == pytest.approx(exact, rel=1e-6, abs=1e-35)


def test_display_transfer_against_the_formula_and_back() -> None:
    values = torch.linspace(0, 1, 1001, dtype=torch.float64)
    shown = srgb_encode(values)
    assert_close(shown, torch.tensor([exact_srgb(v) for v in values.tolist()], dtype=torch.float64))
    assert_close(srgb_decode(shown), values, rtol=0, atol=1e-7)
    inside = torch.tensor([0.001, 0.01, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(srgb_encode, inside)
    torch.autograd.gradcheck(srgb_decode, inside)


@pytest.mark.parametrize(
    ("value", "goal", "moves"), [(1.5, 0.5, True), (1.5, 1.0, False), (-0.5, 0.5, True), (-0.5, 0.0, False)]
)
def test_values_out_of_range_are_led_back(simd: str, value: float, goal: float, moves: bool) -> None:
    prediction, target = torch.full((4, 4, 3), value), torch.full((4, 4, 3), goal)
    for function in (photometric_loss, reference_loss):
        _, gradient = loss_and_gradient(function, prediction, target, None, 0.0)
        slope = 1.055 / 2.4 if value > 1 else 12.92
        expected = math.copysign(slope * 3 / 48, value) if moves else 0.0
        assert_close(gradient, torch.full_like(gradient, expected), rtol=1e-5, atol=0)


def test_the_same_picture_has_no_loss(simd: str) -> None:
    prediction, _ = pictures(20, 30)
    assert abs(float(photometric_loss(prediction, srgb_encode(prediction.clamp(0, 1))))) < 1e-6


def test_threads_do_not_change_a_bit(simd: str) -> None:
    prediction, target = pictures(101, 67)
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        results.append(loss_and_gradient(photometric_loss, prediction, target, some_weights(101, 67)))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_without_a_gradient_the_loss_is_the_same(simd: str) -> None:
    prediction, target = pictures(19, 23)
    loss, _ = loss_and_gradient(photometric_loss, prediction, target)
    assert torch.equal(photometric_loss(prediction, target), loss)


def test_not_a_number_shows(simd: str) -> None:
    prediction, target = pictures(30, 30)
    prediction[15, 15, 1] = torch.nan
    loss, gradient = loss_and_gradient(photometric_loss, prediction, target)
    assert loss.isnan()
    assert gradient[15, 15, 1].isnan()
    assert gradient[:, :, 0].isfinite().all()
    assert gradient[:, :3].isfinite().all()


def test_nothing_to_compare(simd: str) -> None:
    prediction, target = pictures(6, 6)
    for function in (photometric_loss, reference_loss):
        loss, gradient = loss_and_gradient(function, prediction, target, torch.zeros(6, 6))
        assert float(loss) == 0
        assert not gradient.any()
    assert float(photometric_loss(torch.zeros(0, 5, 3), torch.zeros(0, 5, 3))) == 0


def test_other_memory_layouts_and_types() -> None:
    prediction, target = pictures(14, 18)
    weight = some_weights(14, 18)
    expected = photometric_loss(prediction, target, weight)
    turned = prediction.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert torch.equal(photometric_loss(turned, target.double(), weight.bool()), expected)
    assert photometric_loss(prediction.double(), target, weight).dtype == torch.float64


def test_errors_name_what_was_expected() -> None:
    prediction, target = pictures(4, 5)
    with pytest.raises(ValueError, match=r"target: .*\[4, 5, 3\].*\[3, 5, 3\]"):
        photometric_loss(prediction, target[:3])
    with pytest.raises(ValueError, match=r"weight: .*\[4, 5\].*\[5, 4\]"):
        photometric_loss(prediction, target, torch.ones(5, 4))
    with pytest.raises(ValueError, match=r"prediction: .*\[H, W, 3\].*\[4, 5\]"):
        photometric_loss(prediction[..., 0], target)
    with pytest.raises(ValueError, match=r"target: .*\[4, 5, 3\].*\[60\]"):
        _native.photometric(prediction, target.flatten(), None, 20.0, 0.2, None)
