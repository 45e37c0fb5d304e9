"""From pieces of evidence that are not independent to odds that can be believed.

A log-likelihood summed over pixels says 1 - 1e-300, because neighboring pixels, and one surface seen in several
views, share their errors. Evidence is therefore summed within clusters first, and tempered by how much the clusters
disagree: an honest log-likelihood ratio L between two hypotheses has a variance of twice its mean (exactly so for a
shift of a Gaussian), so with the variance V that the clusters show, ``t L`` with ``t = min(1, 2 L / V)`` is what the
sum is worth. In terms of the score ``z = L / sqrt(V)`` that is ``2 z^2``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.inspection.orders import ORDERS, SENSES, ZEROS

DEGREES = 180
"""Zeros are tried at every whole degree."""
FAILURE = 0.01
"""Probability that the model behind a source of evidence does not hold for a capture at all (polarized light, ...)."""
_WINDOW = 22
_GROUPS = 20


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-likelihoods of one source of evidence.

    Attributes:
        source: its name for people.
        clusters: [C, 2, 180] for the clusters, the senses +1 and -1, and zeros at 0, 1, ..., 179 degrees.
        observations: how many pixels or sightings are behind it.
        usable: whether it says enough about its own quality to be used.
        note: a sentence on its quality.
    """

    source: str
    clusters: Tensor
    observations: int
    usable: bool
    note: str


@dataclass(frozen=True)
class Odds:
    """What evidence says about the order and the zero.

    Attributes:
        log_odds: tempered log-likelihood ratio of the best order to each of ``ORDERS``; 0 for the best.
        probabilities: of ``ORDERS``, adding up to 1.
        offset: zero beyond that of the best order, degrees in [-22, 22].
        offset_error: its standard error.
    """

    log_odds: tuple[float, ...]
    probabilities: tuple[float, ...]
    offset: float
    offset_error: float

    @property
    def best(self) -> int:
        """Position of the most probable order."""
        return max(range(len(ORDERS)), key=lambda k: self.probabilities[k])

    @property
    def sense_probability(self) -> float:
        """Probability that the angles count counter-clockwise."""
        return sum(p for p, order in zip(self.probabilities, ORDERS, strict=True) if order.sense > 0)


def odds(evidence: Evidence) -> Odds:
    """Odds of the eight orders from one source of evidence.

    Each order is taken at its best zero within 22 degrees of its own.
    """
    clusters = evidence.clusters.double()
    total = clusters.sum(dim=0)
    places = [(k, *_peak(total[k], zero)) for k in range(len(SENSES)) for zero in ZEROS]
    at_best = torch.stack([clusters[:, sense, place] for sense, place, _ in places], dim=1)
    sums = at_best.sum(dim=0)
    best = int(sums.argmax())
    log_odds = [tempered(at_best[:, best] - at_best[:, k]) for k in range(len(ORDERS))]
    weights = [math.exp(-value) for value in log_odds]
    probabilities = [(1 - FAILURE) * w / sum(weights) + FAILURE / len(ORDERS) for w in weights]
    offset, error = _offset(clusters[:, places[best][0]], ORDERS[best].zero)
    return Odds(tuple(log_odds), tuple(probabilities), offset, error)


def combined(parts: list[Odds]) -> Odds:
    """The odds of independent sources together: probabilities multiply, offsets are averaged by their errors.

    Only offsets about the order that wins count.
    """
    log_odds = [sum(part.log_odds[k] for part in parts) for k in range(len(ORDERS))]
    product = [math.prod(part.probabilities[k] for part in parts) for k in range(len(ORDERS))]
    probabilities = tuple(value / sum(product) for value in product)
    best = max(range(len(ORDERS)), key=lambda k: probabilities[k])
    agreeing = [part for part in parts if part.best == best] or parts
    weights = [1 / max(part.offset_error, 0.05) ** 2 for part in agreeing]
    offset = sum(w * part.offset for w, part in zip(weights, agreeing, strict=True)) / sum(weights)
    least = min(log_odds)
    return Odds(
        tuple(value - least for value in log_odds), probabilities, offset, math.sqrt(1 / sum(weights))
    )


def tempered(ratios: Tensor) -> float:
    """What the log-likelihood ratios [C] of clusters are worth together; 0 where they favor the other side."""
    total, count = float(ratios.sum()), ratios.numel()
    if total <= 0 or count < 2:
        return 0.0
    variance = float(ratios.var()) * count
    return total * min(1.0, 2 * total / variance) if variance > 0 else total


def _peak(profile: Tensor, zero: int) -> tuple[int, float]:
    """Place and value of the largest of a profile [180] within 22 degrees of ``zero``."""
    window = (torch.arange(-_WINDOW, _WINDOW + 1) + zero) % DEGREES
    place = int(window[int(profile[window].argmax())])
    return place, float(profile[place])


def _offset(clusters: Tensor, zero: int) -> tuple[float, float]:
    """The best zero minus ``zero`` in degrees, and its standard error by leaving out groups of clusters."""
    total = clusters.sum(dim=0)
    estimate = _refined(total, zero)
    groups = min(_GROUPS, len(clusters))
    if groups < 2:
        return estimate, math.inf
    left_out = [_refined(total - clusters[k::groups].sum(dim=0), zero) for k in range(groups)]
    spread = sum((value - estimate) ** 2 for value in left_out) * (groups - 1) / groups
    return estimate, max(math.sqrt(spread), 0.05)


def _refined(profile: Tensor, zero: int) -> float:
    """The largest of a profile to a fraction of a degree (a parabola through three places), about ``zero``."""
    place, center = _peak(profile, zero)
    before, after = float(profile[place - 1]), float(profile[(place + 1) % DEGREES])
    bend = before - 2 * center + after
    fraction = 0.5 * (before - after) / bend if bend < 0 else 0.0
    near = (place - zero + DEGREES // 2) % DEGREES - DEGREES // 2
    return near + max(-0.5, min(0.5, fraction))
