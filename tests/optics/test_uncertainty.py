"""Standard deviations of DoLP and AoLP, and the debiased DoLP, against drawn noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from polarguide import optics

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
    with pytest.raises(ValueError, match="variances: expected shape"):
        optics.polarization_uncertainty(torch.zeros(3, 2), torch.zeros(3, 2))
