"""Checks of order, sense and zero of the polarizer angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from polarguide.capture.calibration import Calibration, combined
from polarguide.inspection.likelihood import Evidence, OrderPosterior, combine, posterior
from polarguide.inspection.orders import IDENTITY, ORDERS, PAIRINGS, FileOrder, Order, swaps
from polarguide.inspection.verdict import Check, Verdict

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
        probability: of this order. log_odds: of the most likely order to it, 0 or more.
    """

    order: Order
    files: FileOrder
    probability: float
    log_odds: float


@dataclass(frozen=True, eq=False)
class AngleFindings:
    """The findings on the polarizer angles by geometry.

    Attributes:
        pairing: index into ``PAIRINGS``, from the pair sums. sources: the evidence.
        posterior: of all usable evidence together; None if there is none.
        applied: what ``prepare`` took the angles for; None for a scene of another origin.
    """

    pairing: int
    sources: tuple[Evidence, ...]
    posterior: OrderPosterior | None
    applied: Calibration | None = None

    def correction(self, offset: float) -> str:
        """What to do about a decided order and an offset beside it: the whole calibration, not the difference."""
        if self.files is None:
            return ""
        if self.applied is None:
            return f"{FIX}."
        whole = combined(self.applied, Calibration(order=self.files, zero=round(offset, 1)))
        if whole is None:
            return f"{FIX}."
        return (
            f"{FIX}, or repeat prepare with {whole.options()} and a new --out. That is the whole calibration; the "
            f"scene was prepared with {self.applied.options()}."
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
    sources: Sequence[Evidence], pairing: int, applied: Calibration | None = None
) -> AngleFindings:
    """Combine the usable sources of evidence; ``applied`` as in ``AngleFindings``."""
    usable = [posterior(evidence) for evidence in sources if evidence.usable]
    return AngleFindings(pairing, tuple(sources), combine(usable) if usable else None, applied)


def order_check(angles: AngleFindings) -> Check:
    """Check whether the pictures are named by their true angles."""
    key, title = "angle_order", "Order of the angles"
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
        said = f"The file names are right with a probability of {probability:.1%}."
        return Check(key, title, "ok", said, figures=angles.record())
    return Check(
        key, title, "wrong", f"With a probability of {probability:.1%} {swaps(files)}.",
        angles.correction(angles.offset or 0.0), figures=angles.record(),
    )  # fmt: skip


def handedness_check(angles: AngleFindings) -> Check:
    """Check whether the angles increase counter-clockwise as displayed."""
    key, title = "handedness", "Sense of the angles"
    if angles.posterior is None:
        return Check(key, title, UNVERIFIED, _no_evidence(angles), _more_evidence(angles))
    probability = angles.posterior.sense_probability
    figures = {"counter_clockwise": probability}
    if max(probability, 1 - probability) < DECIDED:
        said = f"Not decided: counter-clockwise with a probability of {probability:.0%}."
        return Check(key, title, "warning", said, _more_evidence(angles), figures=figures)
    if probability > 0.5:
        said = f"Counter-clockwise as displayed, with a probability of {probability:.1%}."
        return Check(key, title, "ok", said, figures=figures)
    return Check(
        key, title, "wrong", f"Clockwise as displayed, with a probability of {1 - probability:.1%}: clockwise angles, "
        "a mirrored picture and two exchanged files look the same.",
        angles.correction(angles.offset or 0.0) or _more_evidence(angles), figures=figures,
    )  # fmt: skip


def zero_check(angles: AngleFindings) -> Check:
    """Check whether the zero of the angles is the image's horizontal."""
    key, title = "zero_offset", "Zero of the angles"
    if angles.posterior is None:
        return Check(key, title, UNVERIFIED, _no_evidence(angles), _more_evidence(angles))
    offset, error = angles.posterior.offset, angles.posterior.offset_error
    figures = {"offset_degrees": offset, "error_degrees": error}
    if not math.isfinite(error) or error > ZERO_UNSURE:
        said = f"The standard error of the zero is {error:.1f}°: too large to decide."
        return Check(key, title, "warning", said, _more_evidence(angles), figures=figures)
    about = "" if angles.order in (None, IDENTITY) else " (relative to the order found above)"
    said = f"The zero of the instrument lies at {offset:+.1f}° ± {error:.1f}°{about}."
    verdict: Verdict = "ok"
    remedy = ""
    if abs(offset) > max(ZERO_OFF / 2, 3 * error):
        verdict = "wrong" if angles.offset is not None else "warning"
        remedy = angles.correction(offset) or _more_evidence(angles)
    return Check(key, title, verdict, said, remedy, figures=figures)


def _no_evidence(angles: AngleFindings) -> str:
    said = " ".join(evidence.note for evidence in angles.sources)
    return (
        f"Geometry does not decide it. {said}".strip()
        if said
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
