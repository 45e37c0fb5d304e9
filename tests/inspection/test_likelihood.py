"""Tempered evidence: honest ratios stay, repeated ones do not grow, contradictions decide nothing."""

from __future__ import annotations

import math

import pytest
import torch

from polarguide.capture.angle_evidence import (
    ORDERS,
    AngleLimits,
    OrderEvidence,
    OrderPosterior,
    combine,
    posterior,
    spatial_cells,
    sum_by_cluster,
    tempered,
)


def test_honest_ratios_keep_their_worth() -> None:
    # Log-likelihood ratios of N(0, 1) against N(0.5, 1): mean 1/8, variance 1/4.
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(4000, generator=generator, dtype=torch.float64)
    ratios = 0.125 - 0.5 * x
    assert tempered(ratios) == pytest.approx(float(ratios.sum()), rel=0.15)


def test_ratios_that_were_counted_ten_times_are_tempered_to_a_tenth() -> None:
    generator = torch.Generator().manual_seed(0)
    ratios = 0.125 - 0.5 * torch.randn(4000, generator=generator, dtype=torch.float64)
    assert tempered(10 * ratios) == pytest.approx(float(ratios.sum()), rel=0.15)


def test_ratios_for_the_other_side_and_single_clusters_say_nothing() -> None:
    assert tempered(torch.tensor([-1.0, -2.0, -3.0])) == 0.0
    assert tempered(torch.tensor([5.0])) == 0.0


def evidence_for(sense: int, zero: float, strength: float, clusters: int = 60) -> OrderEvidence:
    """Noisy evidence for one sense and zero."""
    generator = torch.Generator().manual_seed(3)
    angles = torch.deg2rad(torch.arange(180, dtype=torch.float64))
    shifts = zero + 2 * torch.randn(clusters, 1, generator=generator, dtype=torch.float64)
    profile = strength * torch.cos(2 * (angles - torch.deg2rad(shifts)))
    other = 0.1 * strength * torch.randn(clusters, 180, generator=generator, dtype=torch.float64)
    rows = [profile, other] if sense > 0 else [other, profile]
    return OrderEvidence("test", torch.stack(rows, dim=1), clusters, True, "")


@pytest.mark.parametrize(
    ("sense", "zero", "best"), [(1, 0.0, 0), (1, 96.5, 2), (-1, 38.0, 5), (-1, 174.0, 4)]
)
def test_order_and_offset_are_found_with_their_error(sense: int, zero: float, best: int) -> None:
    found = posterior(evidence_for(sense, zero, 3.0))
    assert found.best == best
    offset = (zero - ORDERS[best].zero + 90) % 180 - 90
    assert found.offset == pytest.approx(offset, abs=max(3 * found.offset_error, 0.1))
    assert 0.05 <= found.offset_error < 1.0
    assert sum(found.probabilities) == pytest.approx(1.0)
    assert max(found.probabilities) == pytest.approx(1 - AngleLimits.failure * 7 / 8, abs=1e-3)
    assert found.sense_probability > 0.95 if sense > 0 else found.sense_probability < 0.05


def test_weak_evidence_decides_nothing() -> None:
    generator = torch.Generator().manual_seed(5)
    noise = torch.randn(40, 2, 180, generator=generator)
    assert max(posterior(OrderEvidence("test", noise, 40, True, "")).probabilities) < 0.8


def some_odds(best: int, offset: float, error: float) -> OrderPosterior:
    probabilities = [AngleLimits.failure / 8] * 8
    probabilities[best] += 1 - AngleLimits.failure
    against = [20.0] * 8
    against[best] = 0.0
    return OrderPosterior(tuple(against), tuple(probabilities), offset, error)


def test_agreeing_sources_strengthen_and_average_by_their_errors() -> None:
    found = combine([some_odds(2, 1.0, 0.1), some_odds(2, 2.0, 0.2)])
    assert found.best == 2
    assert found.probabilities[2] > 0.9999
    assert found.offset == pytest.approx((1.0 / 0.01 + 2.0 / 0.04) / (1 / 0.01 + 1 / 0.04))
    assert found.offset_error == pytest.approx(1 / math.sqrt(125))


def test_contradicting_sources_decide_nothing() -> None:
    found = combine([some_odds(0, 0.0, 0.1), some_odds(2, 0.0, 0.1)])
    assert found.probabilities[0] == pytest.approx(0.5, abs=0.01)
    assert found.probabilities[2] == pytest.approx(0.5, abs=0.01)


def test_cells_part_what_lies_apart_and_sums_follow_them() -> None:
    places = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    numbers = spatial_cells(places)
    assert int(numbers.max()) + 1 == len(numbers.unique()) > 100
    near = (places - places[0]).norm(dim=1) > 0.3
    assert not (numbers[near] == numbers[0]).any()
    sums = sum_by_cluster(torch.ones(500, 2), numbers)
    assert sums.sum() == 1000
    assert sums[numbers[0], 0] == (numbers == numbers[0]).sum()
    assert spatial_cells(torch.zeros(7, 3)).tolist() == [0] * 7
