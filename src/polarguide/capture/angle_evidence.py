"""Decide whether the stated polarizer angles are right, from several sources of evidence.

The functions estimate the order, sense and zero of the angles of all pictures, and the angle of a single picture. There
are five sources of evidence.

- **Pair sums** give the pairing, the pictures that are perpendicular to each other (``decide_pairing``).
- **Outlines of masks** give the sense of a published dataset with Stokes vectors
  (``polarguide_bench.datasets.outlines``).
- **Points** that several views observe, and **normals** of a trained scene, give log-likelihoods of all senses and
  zeros (``inspection.evidence``). ``posterior`` and ``combine`` turn them into probabilities of the orders.
- **Single pictures**: the other pictures of a view (``capture.picture_sets``) or a trained scene (``training.angles``)
  give an ``AngleEstimate`` with a standard error. ``tolerance`` decides if it contradicts the stated angle.
  ``common_rotation`` fits one sense and zero to all estimates.

Within a pairing eight orders remain, the symmetries of a square: a picture named L degrees was taken at ``sense * L +
zero``, with a sense of +1 or -1 and a zero of 0, 45, 90 or 135 degrees. The measured AoLP transforms in the same way.

A log-likelihood summed over pixels would give probabilities like 1 - 1e-300, because neighboring pixels, and one
surface in several views, share their errors. Evidence is therefore summed within spatial clusters first and tempered by
the disagreement of the clusters: a well-calibrated log-likelihood ratio L between two hypotheses has a variance of
twice its mean (exact for a shift of a Gaussian). With the variance V of the clusters, L is replaced by ``t L`` with ``t
= min(1, 2 L / V)``; in terms of the score ``z = L / sqrt(V)`` that is ``2 z^2``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.geometry.polarizer import ANGLES

TO_DEVIATION = 1.4826
"""Ratio of the standard deviation of normally distributed errors to the median of their absolute values."""


class AngleLimits:
    """Constants of the estimates and decisions.

    Attributes:
        sure: number of standard errors above which a difference is certain. ``inspection.shots`` and
            ``inspection.picture_checks`` use 4 instead, because their standard errors do not include systematic errors.
        decided: probability above which an order or a sense is decided.
        zero_off: smallest error of a zero that is reported, in degrees. Half of it causes a warning. It is also the
            largest standard error with which a zero is judged.
        pair_sums: largest ratio of the smallest residual of a pairing to the second smallest with which the pairing is
            decided.
        outline_gain: smallest difference of the agreements of outlines with the two senses at which a view votes for
            a sense. Noise and outlines of flat bodies agree with neither sense.
        outline_share: smallest share of the views that must vote for the same sense.
        alike: smallest length of the mean of (cos 2d, sin 2d) over the differences d of angles at which the pictures
            have a common offset.
        same_direction: length of the mean of doubled (or fourfold) stated angles above which the angles are too
            similar to determine a sense.
        outlier: largest distance from the mean difference in degrees at which a picture contributes to the common
            offset.
        failure: prior probability that the model of a source of evidence is wrong, for example because the light is
            polarized.
        cells: number of cells along the longest side of the box around the middle 90 % of the points.
        least_error: smallest standard error of a zero in degrees, because profiles have steps of one degree.
        window: largest distance in degrees from the zero of an order at which its maximum is searched.
        groups: number of groups of clusters for jackknife errors.
    """

    sure = 3.0
    decided = 0.95
    zero_off = 3.0
    pair_sums = 0.5
    outline_gain = 0.2
    outline_share = 0.75
    alike = 0.4
    same_direction = 0.95
    outlier = 30.0
    failure = 0.01
    cells = 12
    least_error = 0.05
    window = 22
    groups = 8


def angle_difference(angle: Any, other: Any) -> Any:
    """Return the difference of two polarizer angles in degrees modulo 180, in [-90, 90)."""
    return (angle - other + 90.0) % 180.0 - 90.0


def tolerance(floor: float, error: float, usual: float = 0.0, *, sigmas: float = AngleLimits.sure) -> float:
    """Return the largest difference in degrees that does not contradict a stated angle.

    Args:
        floor: smallest difference in degrees that is reported.
        error: standard error of the estimate in degrees.
        usual: median of the absolute differences of all pictures in degrees. If all pictures differ, the model is
            wrong, and not the angles.
        sigmas: number of standard errors by which an estimate may differ by chance.
    """
    return max(floor, sigmas * error, sigmas * TO_DEVIATION * usual)


@dataclass(frozen=True)
class AngleEstimate:
    """Estimate of the polarizer angle of one picture, compared with its stated angle.

    Attributes:
        angle: estimated angle in degrees; None if the picture does not determine the angle.
        error: standard error of the estimate in degrees.
        stated: stated angle in degrees; None if it is unknown.
        floor: smallest difference in degrees that is reported.
        usual: median of the absolute differences of all pictures in degrees.
        sigmas: number of standard errors by which the estimate may differ by chance.
    """

    angle: float | None
    error: float
    stated: float | None
    floor: float
    usual: float = 0.0
    sigmas: float = AngleLimits.sure

    @property
    def off(self) -> float:
        """Estimated angle minus stated angle in degrees, in [-90, 90). It is 0 if one of the two is unknown."""
        unknown = self.angle is None or self.stated is None
        return 0.0 if unknown else float(angle_difference(self.angle, self.stated))

    @property
    def limit(self) -> float:
        """Largest difference in degrees that does not contradict the stated angle."""
        return tolerance(self.floor, self.error, self.usual, sigmas=self.sigmas)

    @property
    def contradicts(self) -> bool:
        """True if the difference exceeds the limit."""
        return abs(self.off) > self.limit


def jackknife_error(estimate: Any, without: Any) -> Any:
    """Compute the standard error of an estimate by the jackknife.

    Args:
        estimate: estimate from all data, [...].
        without: estimates from the data without one group, for each of G groups, [G, ...].
    """
    count = len(without)
    return np.sqrt(((np.asarray(without) - estimate) ** 2).sum(axis=0) * (count - 1) / count)


def mean_angle(angles: Sequence[float], spreads: Sequence[float], least_spread: float) -> tuple[float, float]:
    """Return the weighted mean of angles modulo 180, and their scatter, both in degrees.

    The scatter is half the circular standard deviation of the doubled angles, sqrt(-2 log R) with R the length of their
    mean (Mardia and Jupp, Directional Statistics, 2.3).

    Args:
        angles: angles in degrees.
        spreads: standard deviations in degrees; the weight of an angle is the inverse of its spread.
        least_spread: smallest spread that is used for a weight.
    """
    weights = [1 / max(spread, least_spread) for spread in spreads]
    doubled = [math.radians(2 * angle) for angle in angles]
    sine = sum(weight * math.sin(angle) for weight, angle in zip(weights, doubled, strict=True))
    cosine = sum(weight * math.cos(angle) for weight, angle in zip(weights, doubled, strict=True))
    length = min(max(math.hypot(sine, cosine) / sum(weights), 1e-6), 1.0)
    mean = math.degrees(math.atan2(sine, cosine) / 2) % 180.0
    return mean, min(math.degrees(math.sqrt(-2 * math.log(length))) / 2, 90.0)


class CommonRotation(NamedTuple):
    """Rotation that relates the stated angles of all pictures to the estimated angles: ``sense * stated + offset``.

    Attributes:
        sense: 1 for the stated sense, -1 for the opposite sense, or None if neither explains the estimated angles.
        offset: offset of the zero in degrees.
        error: standard error of the offset in degrees.
    """

    sense: int | None = None
    offset: float = 0.0
    error: float = math.inf


def common_rotation(estimated: Sequence[float], stated: Sequence[float]) -> CommonRotation:
    """Return the rotation that explains most of the estimated angles by the stated ones, all in degrees."""
    from_pictures = np.radians(estimated)
    from_capture = np.radians(stated)
    turns = {sense: np.exp(2j * (from_pictures - sense * from_capture)) for sense in (1, -1)}
    alike = abs(np.exp(2j * from_capture).mean()) > AngleLimits.same_direction
    sense = 1 if alike or abs(turns[1].mean()) >= abs(turns[-1].mean()) else -1
    turn = turns[sense]
    if abs(turn.mean()) < AngleLimits.alike:
        return CommonRotation()
    # The mean is computed with all differences, and again without outliers.
    near = turn[np.abs(np.angle(turn / turn.mean())) < math.radians(2 * AngleLimits.outlier)]
    apart = np.degrees(np.angle(near / near.mean())) / 2
    error = float(TO_DEVIATION * np.median(np.abs(apart)) / math.sqrt(len(near)) * 1.25)
    return CommonRotation(sense, float(np.degrees(np.angle(near.mean())) / 2), error)


FileOrder = tuple[int, int, int, int]
"""True angle in degrees of each of the pictures named 0, 45, 90 and 135."""
PAIRINGS: tuple[FileOrder, ...] = ((0, 45, 90, 135), (0, 90, 45, 135), (0, 45, 135, 90))
"""The three ways to form two pairs of perpendicular pictures. Each is represented by one order of the angles.

``capture.checks.Measures.residuals`` has the same order.
"""
SENSES = (1, -1)
"""Senses of the two rows of a profile in ``OrderEvidence``. 1 is counter-clockwise, -1 is clockwise."""


def decide_pairing(residuals: NDArray[np.float64]) -> int | None:
    """Decide which pictures are perpendicular, from the residuals of the pair sums.

    Args:
        residuals: ``capture.checks.Measures.residuals`` of each view, [V, 3].

    Returns:
        Index into ``PAIRINGS`` of the pairing whose residuals are by far the smallest. It is ``None`` if no pairing is
        clearly the best.
    """
    residuals = residuals[residuals.max(axis=1) > 0]
    if len(residuals) == 0:
        return None
    medians = np.median(residuals, axis=0)
    best = int(medians.argmin())
    return best if medians[best] < AngleLimits.pair_sums * float(np.delete(medians, best).min()) else None


@dataclass(frozen=True)
class Order:
    """One of the eight combinations of sense and zero that leave the pairs of perpendicular pictures unchanged.

    Attributes:
        sense: +1 if the angles increase counter-clockwise as displayed, -1 if they increase clockwise.
        zero: direction of angle zero in degrees, counter-clockwise from the picture's horizontal.
    """

    sense: int
    zero: int

    def files(self, pairing: FileOrder = ANGLES) -> FileOrder:
        """Return the true angles of the pictures named 0, 45, 90 and 135 for an index into ``PAIRINGS``."""
        first, second, third, fourth = ((self.sense * angle + self.zero) % 180 for angle in pairing)
        return first, second, third, fourth

    @property
    def label(self) -> str:
        """Sense and zero as text."""
        return f"{'counter-clockwise' if self.sense > 0 else 'clockwise'}, zero at {self.zero}°"


ORDERS: tuple[Order, ...] = tuple(Order(sense, zero) for sense in SENSES for zero in ANGLES)
"""All eight orders; the first is the identity."""
IDENTITY = ORDERS[0]
"""Order of pictures whose names state the true angles."""


def swaps(files: FileOrder) -> str:
    """Describe wrong file names: "the picture named 45° was taken at 135°, ..."."""
    moved = [(name, true) for name, true in zip(ANGLES, files, strict=True) if name != true]
    return ", ".join(f"the picture named {name}° was taken at {true}°" for name, true in moved) or "nothing"


DEGREES = 180
"""Number of zeros in a profile, one per degree."""


@dataclass(frozen=True, eq=False)
class OrderEvidence:
    """Log-likelihoods of all senses and zeros according to one source of evidence.

    Attributes:
        source: name of the source in messages.
        clusters: log-likelihoods of C spatial clusters, for the senses +1 and -1 and for zeros at 0, 1, ..., 179
            degrees, [C, 2, 180].
        observations: number of pixels or observations.
        usable: True if the quality of the evidence is sufficient.
        note: sentence for the user about the quality.
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
        probabilities: probabilities of ``ORDERS``, which add up to 1.
        offset: zero relative to that of the best order, degrees in [-22, 22].
        offset_error: standard error of the offset, degrees.
    """

    log_odds: tuple[float, ...]
    probabilities: tuple[float, ...]
    offset: float
    offset_error: float

    @property
    def best(self) -> int:
        """Index of the most probable order."""
        return self.probabilities.index(max(self.probabilities))

    @property
    def order(self) -> Order | None:
        """Order whose probability is high enough for a decision, or None."""
        return ORDERS[self.best] if max(self.probabilities) >= AngleLimits.decided else None

    @property
    def is_precise(self) -> bool:
        """True if the standard error of the zero is small enough to judge it."""
        return self.offset_error <= AngleLimits.zero_off

    def is_off(self, limit: float) -> bool:
        """Return True if the zero deviates from the stated zero significantly, and by more than ``limit`` degrees."""
        return abs(self.offset) > tolerance(limit, self.offset_error)

    @property
    def sense_probability(self) -> float:
        """Probability that the angles increase counter-clockwise."""
        return sum(p for p, order in zip(self.probabilities, ORDERS, strict=True) if order.sense > 0)


def posterior(evidence: OrderEvidence) -> OrderPosterior:
    """Compute the posterior probabilities of the eight orders from one source of evidence.

    The likelihood of an order is that of the best zero within 22 degrees of the order's zero.
    """
    clusters = evidence.clusters.double()
    rows = [SENSES.index(order.sense) for order in ORDERS]
    total = clusters.sum(dim=0)
    peaks = [_peak(total[row], order.zero) for row, order in zip(rows, ORDERS, strict=True)]
    at_best = clusters[:, rows, peaks]
    best = int(at_best.sum(dim=0).argmax())
    log_odds = tuple(tempered(at_best[:, best] - at_best[:, k]) for k in range(len(ORDERS)))
    weights = [math.exp(-value) for value in log_odds]
    probabilities = tuple(
        (1 - AngleLimits.failure) * w / sum(weights) + AngleLimits.failure / len(ORDERS) for w in weights
    )
    return OrderPosterior(log_odds, probabilities, *_offset(clusters[:, rows[best]], ORDERS[best].zero))


def combine(parts: Sequence[OrderPosterior]) -> OrderPosterior:
    """Combine the probabilities of independent sources of evidence by multiplication.

    The offset is the mean of the offsets with weights 1 / error^2. A source contributes to it only if its most probable
    order is the most probable order of all sources together.
    """
    log_odds = np.sum([part.log_odds for part in parts], axis=0)
    product = np.prod([part.probabilities for part in parts], axis=0)
    best = int(product.argmax())
    agreeing = [part for part in parts if part.best == best] or parts
    weights = [1 / max(part.offset_error, AngleLimits.least_error) ** 2 for part in agreeing]
    offset = sum(w * part.offset for w, part in zip(weights, agreeing, strict=True)) / sum(weights)
    return OrderPosterior(
        tuple((log_odds - log_odds.min()).tolist()),
        tuple((product / product.sum()).tolist()),
        offset,
        math.sqrt(1 / sum(weights)),
    )


def tempered(ratios: Tensor) -> float:
    """Return the sum of the log-likelihood ratios of C clusters, [C], reduced according to their disagreement.

    The description of this module explains the reduction. A negative sum gives 0.
    """
    total = float(ratios.sum())
    count = ratios.numel()
    if total <= 0 or count < 2:
        return 0.0
    variance = float(ratios.var()) * count
    return total * min(1.0, 2 * total / variance) if variance > 0 else total


def _peak(profile: Tensor, zero: int) -> int:
    """Return the angle in degrees of the maximum of a profile [180] within 22 degrees of ``zero``."""
    window = (torch.arange(-AngleLimits.window, AngleLimits.window + 1) + zero) % DEGREES
    return int(window[int(profile[window].argmax())])


def _offset(clusters: Tensor, zero: int) -> tuple[float, float]:
    """Estimate the deviation of the best zero from ``zero``.

    Returns:
        The deviation in degrees; and its standard error, by a jackknife over groups of neighboring clusters.
    """
    total = clusters.sum(dim=0)
    estimate = _refined(total, zero)
    groups = min(AngleLimits.groups, len(clusters))
    if groups < 2:
        return estimate, math.inf
    without = [_refined(total - part.sum(dim=0), zero) for part in clusters.tensor_split(groups)]
    return estimate, max(float(jackknife_error(estimate, without)), AngleLimits.least_error)


def _refined(profile: Tensor, zero: int) -> float:
    """Return the angle of a profile's maximum relative to ``zero`` in degrees.

    A parabola through three values of the profile gives fractions of a degree.
    """
    degree = _peak(profile, zero)
    before, center, after = profile[[degree - 1, degree, (degree + 1) % DEGREES]].tolist()
    bend = before - 2 * center + after
    fraction = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(angle_difference(degree, zero)) + max(-0.5, min(0.5, fraction))


def spatial_cells(points: Tensor) -> Tensor:
    """Divide space into the cells of a regular grid, and return the cell index of each point [N, 3], [N] int64.

    The indices are 0, 1, ... without gaps, because empty cells have no index.
    """
    step = max(1, len(points) // 100_000)
    low, high = (torch.quantile(points[::step].double(), q, dim=0) for q in (0.05, 0.95))
    side = float((high - low).max()) / AngleLimits.cells
    if side <= 0:
        return torch.zeros(len(points), dtype=torch.int64)
    # Points far outside share one layer of cells: they are few.
    numbers = ((points.double() - low) / side).floor().clamp(-1, AngleLimits.cells + 1).long() + 1
    key = (numbers[:, 0] * (AngleLimits.cells + 3) + numbers[:, 1]) * (AngleLimits.cells + 3) + numbers[:, 2]
    return torch.unique(key, return_inverse=True)[1]


def sum_by_cluster(values: Tensor, numbers: Tensor) -> Tensor:
    """Return the sum of values [N, ...] in each of C clusters, [C, ...]. ``numbers`` [N] has their cluster indices."""
    count = int(numbers.max()) + 1 if len(numbers) else 1
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, numbers, values)
