"""The sRGB transfer against its standard (IEC 61966-2-1)."""

from __future__ import annotations

import pytest
import torch

from polarguide.optics.color import srgb_decode, srgb_encode


def standard(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def test_encoding_is_the_standards_formula() -> None:
    values = torch.linspace(0, 1, 400, dtype=torch.float64)
    expected = torch.tensor([standard(float(v)) for v in values], dtype=torch.float64)
    torch.testing.assert_close(srgb_encode(values), expected)


@pytest.mark.parametrize(
    ("linear", "code"), [(0.0, 0), (1.0, 255), (0.21404, 127.5), (0.0722, 75.96), (0.0003035, 1.0)]
)
def test_known_codes(linear: float, code: float) -> None:
    assert 255 * float(srgb_encode(torch.tensor(linear))) == pytest.approx(code, abs=0.1)


def test_decoding_is_the_inverse() -> None:
    values = torch.linspace(0, 1, 999, dtype=torch.float64)
    torch.testing.assert_close(srgb_decode(srgb_encode(values)), values, atol=1e-7, rtol=1e-6)
    torch.testing.assert_close(srgb_encode(srgb_decode(values)), values, atol=1e-7, rtol=1e-6)


def test_gradients_against_finite_differences() -> None:
    values = torch.tensor([1e-4, 2e-3, 0.01, 0.2, 0.7, 1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(srgb_encode, (values,))
    assert torch.autograd.gradcheck(srgb_decode, (values,))


@pytest.mark.parametrize("function", [srgb_encode, srgb_decode])
def test_gradients_are_finite_at_black_and_below(function: object) -> None:
    values = torch.tensor([-0.1, 0.0, 1e-12], requires_grad=True)
    function(values).sum().backward()  # type: ignore[operator]
    assert values.grad is not None
    assert bool(torch.isfinite(values.grad).all())
    assert bool((values.grad > 0).all())
