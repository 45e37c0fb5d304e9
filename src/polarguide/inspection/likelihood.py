"""Posterior probabilities of the angle orders from correlated evidence.

A log-likelihood summed over pixels would give probabilities like 1 - 1e-300, because neighboring pixels, and one
surface in several views, share their errors. Evidence is therefore summed within spatial clusters first and tempered
by the disagreement of the clusters: a well-calibrated log-likelihood ratio L between two hypotheses has a variance of
twice its mean (exact for a shift of a Gaussian). With the variance V of the clusters, L is replaced by ``t L`` with
``t = min(1, 2 L / V)``; in terms of the score ``z = L / sqrt(V)`` that is ``2 z^2``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.inspection.orders import ORDERS, SENSES, ZEROS

DEGREES = 180
"""Number of zeros that are tried, one per degree."""
FAILURE = 0.01
"""Prior probability that the model of a source of evidence does not hold for a capture (polarized light, ...)."""
CELLS = 12
"""Cells along the longest side of the box that contains the middle 90 % of the points."""
_WINDOW = 22
_GROUPS = 20


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-likelihoods of one source of evidence.

    Attributes:
        source: its name for people.
        clusters: [C, 2, 180] for the clusters, the senses +1 and -1, and zeros at 0, 1, ..., 179 degrees.
        observations: number of pixels or observations that it comes from.
        usable: whether its quality suffices.
        note: a sentence about its quality.
    """

    source: str
    clusters: Tensor
    observations: int
    usable: bool
    note: str


@dataclass(frozen=True)
class OrderPosterior:
    """Posterior probabilities of the orders, and an estimate of the zero.

    Attributes:
        log_odds: tempered log-likelihood ratio of the best order to each of ``ORDERS``; 0 for the best.
        probabilities: of ``ORDERS``, adding up to 1.
        offset: zero relative to that of the best order, degrees in [-22, 22].
        offset_error: its standard error.
    """

    log_odds: tuple[float, ...]
    probabilities: tuple[float, ...]
    offset: float
    offset_error: float

    @property
    def best(self) -> int:
        """Index of the most probable order."""
        return max(range(len(ORDERS)), key=lambda k: self.probabilities[k])

    @property
    def sense_probability(self) -> float:
        """Probability that the angles count counter-clockwise."""
        return sum(p for p, order in zip(self.probabilities, ORDERS, strict=True) if order.sense > 0)


def posterior(evidence: Evidence) -> OrderPosterior:
    """Posterior probabilities of the eight orders from one source of evidence.

    Each order is evaluated at the best zero within 22 degrees of its own.
    """
    clusters = evidence.clusters.double()
    total = clusters.sum(dim=0)
    peaks = [(k, *_peak(total[k], zero)) for k in range(len(SENSES)) for zero in ZEROS]
    at_best = torch.stack([clusters[:, sense, degree] for sense, degree, _ in peaks], dim=1)
    sums = at_best.sum(dim=0)
    best = int(sums.argmax())
    log_odds = [tempered(at_best[:, best] - at_best[:, k]) for k in range(len(ORDERS))]
    weights = [math.exp(-value) for value in log_odds]
    probabilities = [(1 - FAILURE) * w / sum(weights) + FAILURE / len(ORDERS) for w in weights]
    offset, error = _offset(clusters[:, peaks[best][0]], ORDERS[best].zero)
    return OrderPosterior(tuple(log_odds), tuple(probabilities), offset, error)


def combine(parts: list[OrderPosterior]) -> OrderPosterior:
    """Combine independent sources: probabilities are multiplied, offsets averaged with weights 1 / error^2.

    Only sources whose best order is the combined best one contribute to the offset.
    """
    log_odds = [sum(part.log_odds[k] for part in parts) for k in range(len(ORDERS))]
    product = [math.prod(part.probabilities[k] for part in parts) for k in range(len(ORDERS))]
    probabilities = tuple(value / sum(product) for value in product)
    best = max(range(len(ORDERS)), key=lambda k: probabilities[k])
    agreeing = [part for part in parts if part.best == best] or parts
    weights = [1 / max(part.offset_error, 0.05) ** 2 for part in agreeing]
    offset = sum(w * part.offset for w, part in zip(weights, agreeing, strict=True)) / sum(weights)
    least = min(log_odds)
    return OrderPosterior(
        tuple(value - least for value in log_odds), probabilities, offset, math.sqrt(1 / sum(weights))
    )


def tempered(ratios: Tensor) -> float:
    """The tempered sum of the clusters' log-likelihood ratios [C]; 0 if it is negative."""
    total, count = float(ratios.sum()), ratios.numel()
    if total <= 0 or count < 2:
        return 0.0
    variance = float(ratios.var()) * count
    return total * min(1.0, 2 * total / variance) if variance > 0 else total


def _peak(profile: Tensor, zero: int) -> tuple[int, float]:
    """Index and value of the maximum of a profile [180] within 22 degrees of ``zero``."""
    window = (torch.arange(-_WINDOW, _WINDOW + 1) + zero) % DEGREES
    degree = int(window[int(profile[window].argmax())])
    return degree, float(profile[degree])


def _offset(clusters: Tensor, zero: int) -> tuple[float, float]:
    """The best zero minus ``zero`` in degrees, and its standard error (jackknife over groups of clusters)."""
    total = clusters.sum(dim=0)
    estimate = _refined(total, zero)
    groups = min(_GROUPS, len(clusters))
    if groups < 2:
        return estimate, math.inf
    left_out = [_refined(total - clusters[k::groups].sum(dim=0), zero) for k in range(groups)]
    spread = sum((value - estimate) ** 2 for value in left_out) * (groups - 1) / groups
    return estimate, max(math.sqrt(spread), 0.05)


def _refined(profile: Tensor, zero: int) -> float:
    """Position of a profile's maximum relative to ``zero``, refined by a parabola through three degrees."""
    degree, center = _peak(profile, zero)
    before, after = float(profile[degree - 1]), float(profile[(degree + 1) % DEGREES])
    bend = before - 2 * center + after
    fraction = 0.5 * (before - after) / bend if bend < 0 else 0.0
    near = (degree - zero + DEGREES // 2) % DEGREES - DEGREES // 2
    return near + max(-0.5, min(0.5, fraction))


def spatial_cells(peaks: Tensor) -> Tensor:
    """Cell index of each point [N, 3] in a regular grid, [N] int64, from 0 up without gaps."""
    step = max(1, len(peaks) // 100_000)
    low, high = (torch.quantile(peaks[::step].double(), q, dim=0) for q in (0.05, 0.95))
    side = float((high - low).max()) / CELLS
    if side <= 0:
        return torch.zeros(len(peaks), dtype=torch.int64)
    # Points far outside share one layer of cells: they are few.
    numbers = ((peaks.double() - low) / side).floor().clamp(-1, CELLS + 1).long() + 1
    key = (numbers[:, 0] * (CELLS + 3) + numbers[:, 1]) * (CELLS + 3) + numbers[:, 2]
    return torch.unique(key, return_inverse=True)[1]


def sum_by_cluster(values: Tensor, numbers: Tensor) -> Tensor:
    """Sums [C, ...] of values [N, ...] over the clusters with indices ``numbers`` [N]."""
    count = int(numbers.max()) + 1 if len(numbers) else 1
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, numbers, values)
