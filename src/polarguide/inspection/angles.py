"""Order, sense and zero of the polarizer angles: the possible orders, their posterior probabilities, and the checks.

The pair sums decide which pictures are perpendicular to each other (three pairings). Within a pairing eight orders
remain, the symmetries of a square: a picture named L degrees was taken at ``sense * L + zero``, with a sense of +1 or
-1 and a zero of 0, 45, 90 or 135 degrees. The measured AoLP transforms the same way.

A log-likelihood summed over pixels would give probabilities like 1 - 1e-300, because neighboring pixels, and one
surface in several views, share their errors. Evidence is therefore summed within spatial clusters first and tempered
by the disagreement of the clusters: a well-calibrated log-likelihood ratio L between two hypotheses has a variance of
twice its mean (exact for a shift of a Gaussian). With the variance V of the clusters, L is replaced by ``t L`` with
``t = min(1, 2 L / V)``; in terms of the score ``z = L / sqrt(V)`` that is ``2 z^2``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from polarguide.capture.calibration import Calibration, combined
from polarguide.capture.view import ANGLES
from polarguide.inspection.settings import Check, Verdict

FileOrder = tuple[int, int, int, int]

PAIRINGS: tuple[FileOrder, ...] = ((0, 45, 90, 135), (0, 90, 45, 135), (0, 45, 135, 90))
"""One order for each way to pair the pictures, in the order of ``capture.checks.Measures.residuals``."""
SENSES = (1, -1)
ZEROS = (0, 45, 90, 135)


@dataclass(frozen=True)
class Order:
    """One of the eight orders within a pairing.

    Attributes:
        sense: +1 if the angles increase counter-clockwise as displayed, -1 if clockwise.
        zero: direction of their zero, degrees counter-clockwise from the image's horizontal.
    """

    sense: int
    zero: int

    def files(self, pairing: FileOrder = ANGLES) -> FileOrder:
        """The true angles of the pictures named 0, 45, 90 and 135."""
        first, second, third, fourth = ((self.sense * angle + self.zero) % 180 for angle in pairing)
        return first, second, third, fourth

    @property
    def label(self) -> str:
        """Sense and zero in words."""
        return f"{'counter-clockwise' if self.sense > 0 else 'clockwise'}, zero at {self.zero}°"


ORDERS: tuple[Order, ...] = tuple(Order(sense, zero) for sense in SENSES for zero in ZEROS)
"""All eight orders; the first is the identity."""
IDENTITY = ORDERS[0]


def swaps(files: FileOrder) -> str:
    """A description of wrong file names: "the picture named 45° was taken at 135°, ..."."""
    moved = [(name, true) for name, true in zip(ANGLES, files, strict=True) if name != true]
    if not moved:
        return "nothing"
    return ", ".join(f"the picture named {name}° was taken at {true}°" for name, true in moved)


DEGREES = 180
"""Number of zeros that are tried, one per degree."""
FAILURE = 0.01
"""Prior probability that the model of a source of evidence does not hold for a capture (polarized light, ...)."""
CELLS = 12
"""Cells along the longest side of the box that contains the middle 90 % of the points."""
_WINDOW = 22
_GROUPS = 8


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
    total = float(ratios.sum())
    count = ratios.numel()
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
    """The best zero minus ``zero`` in degrees, and its standard error: a jackknife over clusters that lie together."""
    total = clusters.sum(dim=0)
    estimate = _refined(total, zero)
    groups = min(_GROUPS, len(clusters))
    if groups < 2:
        return estimate, math.inf
    left_out = [_refined(total - part.sum(dim=0), zero) for part in clusters.tensor_split(groups)]
    spread = sum((value - estimate) ** 2 for value in left_out) * (groups - 1) / groups
    return estimate, max(math.sqrt(spread), 0.05)


def _refined(profile: Tensor, zero: int) -> float:
    """Position of a profile's maximum relative to ``zero``, refined by a parabola through three degrees."""
    degree, center = _peak(profile, zero)
    before = float(profile[degree - 1])
    after = float(profile[(degree + 1) % DEGREES])
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


DECIDED = 0.95
"""Probability from which an order counts as decided."""
ZERO_OFF = 3.0
"""Degrees of zero offset from which on it is wrong, beyond three standard errors; from half of it on, a warning."""
ZERO_UNSURE = 3.0
"""Standard error in degrees above which a zero offset gets no verdict."""
FIX = "Write a corrected scene with --fix FOLDER"
UNVERIFIED: Verdict = "not verified"


@dataclass(frozen=True)
class Hypothesis:
    """One of the eight orders, and what the evidence says of it.

    Attributes:
        order: sense and zero. files: the angles that the pictures called 0, 45, 90 and 135 were taken at.
        probability: probability of this order. log_odds: log odds of the most likely order to it, 0 or more.
    """

    order: Order
    files: FileOrder
    probability: float
    log_odds: float


MOSAICS = {
    (1, 45): "--flip x (Reverse X), or --flip 90 (turned counter-clockwise)",
    (1, 135): "--flip y (Reverse Y), or --flip 270 (turned clockwise)",
    (1, 90): "--flip xy (Reverse X and Y), or --offset-x 1 --offset-y 1",
    (-1, 135): "--offset-x 1",
    (-1, 45): "--offset-y 1",
}
"""Sense and zero that geometry finds -> what makes such angles of the mosaics of a sensor."""


@dataclass(frozen=True, eq=False)
class AngleFindings:
    """The findings on the polarizer angles by geometry.

    Attributes:
        pairing: index into ``PAIRINGS``, from the pair sums. sources: the evidence.
        posterior: posterior of all usable evidence together; None if there is none.
        applied: what ``prepare`` took the angles for; None for a scene of another origin.
        mosaic: whether ``prepare`` made the pictures of mosaics of a sensor.
    """

    pairing: int
    sources: tuple[Evidence, ...]
    posterior: OrderPosterior | None
    applied: Calibration | None = None
    mosaic: bool = False

    def correction(self, offset: float) -> str:
        """Advice for a decided order and an offset: the whole calibration, not the difference."""
        if self.files is None:
            return ""
        if self.applied is None:
            return f"{FIX}."
        mirrored = self._mirrored(offset)
        if mirrored:
            return mirrored
        whole = combined(self.applied, Calibration(order=self.files, zero=round(offset, 1)))
        if whole is None:
            return f"{FIX}."
        return (
            f"{FIX}, or repeat prepare with {whole.options()} and a new --out. That is the whole calibration; the "
            f"scene was prepared with {self.applied.options()}."
        )

    def _mirrored(self, offset: float) -> str:
        """Advice where the order is that of a sensor's mosaic that was mirrored, turned, or cropped at odd pixels."""
        straight = self.applied is not None and self.applied.true_angles() == (ANGLES, 0.0)
        if not self.mosaic or not straight or self.order is None or abs(offset) > ZERO_OFF:
            return ""
        options = MOSAICS.get((self.order.sense, self.order.zero))
        if options is None:
            return ""
        return (
            "A sensor's angles are fixed: the mosaics were mirrored or turned, or their region begins elsewhere. "
            f"Repeat prepare with {options} and a new --out."
        )

    @property
    def order(self) -> Order | None:
        """The order, or None if it is not decided."""
        if self.posterior is None or self.posterior.probabilities[self.posterior.best] < DECIDED:
            return None
        return ORDERS[self.posterior.best]

    @property
    def files(self) -> FileOrder | None:
        """The true angles of the pictures named 0, 45, 90 and 135, or None if they are not decided."""
        return None if self.order is None else self.order.files(PAIRINGS[self.pairing])

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All eight, in the order of ``ORDERS``; none without evidence."""
        if self.posterior is None:
            return ()
        rows = zip(ORDERS, self.posterior.probabilities, self.posterior.log_odds, strict=True)
        return tuple(
            Hypothesis(order, order.files(PAIRINGS[self.pairing]), p, odds) for order, p, odds in rows
        )

    @property
    def offset(self) -> float | None:
        """The significant zero offset relative to the order, in degrees; None if there is none."""
        if self.order is None or self.posterior is None or self.posterior.offset_error > ZERO_UNSURE:
            return None
        significant = abs(self.posterior.offset) > max(ZERO_OFF, 3 * self.posterior.offset_error)
        return self.posterior.offset if significant else None

    def record(self) -> dict[str, Any]:
        """As plain JSON types."""
        hypotheses = [
            {
                "files": list(row.files),
                "sense": "ccw" if row.order.sense > 0 else "cw",
                "zero_degrees": row.order.zero,
                "probability": row.probability,
                "log_odds_against": row.log_odds,
            }
            for row in self.hypotheses
        ]
        return {
            "decided": self.order is not None,
            "order": None if self.files is None else list(self.files),
            "zero_offset_degrees": None if self.posterior is None else self.posterior.offset,
            "zero_offset_error_degrees": None if self.posterior is None else self.posterior.offset_error,
            "hypotheses": hypotheses,
            "sources": [
                {"source": e.source, "observations": e.observations, "usable": e.usable, "note": e.note}
                for e in self.sources
            ],
        }


def combine_evidence(
    sources: Sequence[Evidence], pairing: int, applied: Calibration | None = None, *, mosaic: bool = False
) -> AngleFindings:
    """Combine the usable sources of evidence; ``applied`` and ``mosaic`` as in ``AngleFindings``."""
    usable = [posterior(evidence) for evidence in sources if evidence.usable]
    return AngleFindings(pairing, tuple(sources), combine(usable) if usable else None, applied, mosaic)


def order_check(angles: AngleFindings) -> Check:
    """Check whether the pictures are named by their true angles."""
    key = "angle_order"
    title = "Order of the angles"
    if angles.posterior is None:
        return Check(
            key, title, UNVERIFIED, _no_evidence(angles), _more_evidence(angles), figures=angles.record()
        )
    best = angles.posterior.best
    probability = angles.posterior.probabilities[best]
    files = ORDERS[best].files(PAIRINGS[angles.pairing])
    if angles.order is None:
        likely = [row for row in angles.hypotheses if row.probability > 0.02]
        likely.sort(key=lambda row: -row.probability)
        rivals = [f"{', '.join(map(str, row.files))} ({row.probability:.0%})" for row in likely]
        return Check(
            key, title, "warning",
            f"Not decided. The pictures named 0, 45, 90, 135 were taken at {' or '.join(rivals)}.",
            _more_evidence(angles), figures=angles.record(),
        )  # fmt: skip
    if files == PAIRINGS[0]:
        finding = f"The file names are right with a probability of {probability:.1%}."
        return Check(key, title, "ok", finding, figures=angles.record())
    return Check(
        key, title, "wrong", f"With a probability of {probability:.1%} {swaps(files)}.",
        angles.correction(angles.offset or 0.0), figures=angles.record(),
    )  # fmt: skip


def handedness_check(angles: AngleFindings) -> Check:
    """Check whether the angles increase counter-clockwise as displayed."""
    key = "handedness"
    title = "Sense of the angles"
    if angles.posterior is None:
        return Check(key, title, UNVERIFIED, _no_evidence(angles), _more_evidence(angles))
    probability = angles.posterior.sense_probability
    figures = {"counter_clockwise": probability}
    if max(probability, 1 - probability) < DECIDED:
        finding = f"Not decided: counter-clockwise with a probability of {probability:.0%}."
        return Check(key, title, "warning", finding, _more_evidence(angles), figures=figures)
    if probability > 0.5:
        finding = f"Counter-clockwise as displayed, with a probability of {probability:.1%}."
        return Check(key, title, "ok", finding, figures=figures)
    return Check(
        key, title, "wrong", f"Clockwise as displayed, with a probability of {1 - probability:.1%}: clockwise angles, "
        "a mirrored picture and two exchanged files look the same.",
        angles.correction(angles.offset or 0.0) or _more_evidence(angles), figures=figures,
    )  # fmt: skip


def zero_check(angles: AngleFindings) -> Check:
    """Check whether a polarizer angle of 0 degrees is the image's horizontal."""
    key = "zero_offset"
    title = "Zero of the angles"
    if angles.posterior is None:
        return Check(key, title, UNVERIFIED, _no_evidence(angles), _more_evidence(angles))
    offset = angles.posterior.offset
    error = angles.posterior.offset_error
    figures = {"offset_degrees": offset, "error_degrees": error}
    if not math.isfinite(error) or error > ZERO_UNSURE:
        finding = f"The standard error of the zero is {error:.1f}°: too large to decide."
        return Check(key, title, "warning", finding, _more_evidence(angles), figures=figures)
    about = "" if angles.order in (None, IDENTITY) else " (relative to the order found above)"
    finding = f"The zero of the instrument lies at {offset:+.1f}° ± {error:.1f}°{about}."
    verdict: Verdict = "ok"
    remedy = ""
    if abs(offset) > max(ZERO_OFF / 2, 3 * error):
        verdict = "wrong" if angles.offset is not None else "warning"
        remedy = angles.correction(offset) or _more_evidence(angles)
    return Check(key, title, verdict, finding, remedy, figures=figures)


def _no_evidence(angles: AngleFindings) -> str:
    finding = " ".join(evidence.note for evidence in angles.sources)
    return (
        f"Geometry does not decide it. {finding}".strip()
        if finding
        else "This check needs poses, which the scene does not have."
    )


def _more_evidence(angles: AngleFindings) -> str:
    if not angles.sources:
        return "Give the scene poses (polarguide prepare ... --poses sfm) and inspect it again."
    return (
        "Take views from more directions, also rolled or slanted ones, of curved glossy dielectrics; or train longer "
        "with --steps. The sense needs surfaces that face different ways in the picture; the multiple of 90 degrees "
        "needs strong reflections."
    )
