"""Verdicts on order, sense and zero of the polarizer angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from polarguide.inspection.likelihood import Evidence, Odds, combined, odds
from polarguide.inspection.orders import IDENTITY, ORDERS, PAIRINGS, FileOrder, Order, swaps
from polarguide.inspection.verdict import Check, Verdict

DECIDED = 0.95
"""Probability from which on an order is taken as found."""
ZERO_OFF = 3.0
"""Degrees of zero offset from which on it is wrong, beyond three standard errors; from half of it on, a warning."""
ZERO_UNSURE = 3.0
"""Standard error in degrees above which a zero offset is not judged."""
FIX = "Write a corrected scene with --fix FOLDER"


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
class Angles:
    """What geometry says of the angles.

    Attributes:
        pairing: position in ``PAIRINGS`` that the sums chose. sources: the evidence. odds: of it together, or None.
    """

    pairing: int
    sources: tuple[Evidence, ...]
    odds: Odds | None

    @property
    def order(self) -> Order | None:
        """The order, where it is decided."""
        if self.odds is None or self.odds.probabilities[self.odds.best] < DECIDED:
            return None
        return ORDERS[self.odds.best]

    @property
    def files(self) -> FileOrder | None:
        """The angles that the pictures called 0, 45, 90 and 135 were taken at, where they are decided."""
        return None if self.order is None else self.order.files(PAIRINGS[self.pairing])

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All eight, in the order of ``ORDERS``; none without evidence."""
        if self.odds is None:
            return ()
        rows = zip(ORDERS, self.odds.probabilities, self.odds.log_odds, strict=True)
        return tuple(
            Hypothesis(order, order.files(PAIRINGS[self.pairing]), p, odds) for order, p, odds in rows
        )

    @property
    def offset(self) -> float | None:
        """Degrees of zero offset beyond the order that should be turned back; None where nothing is off for sure."""
        if self.order is None or self.odds is None or self.odds.offset_error > ZERO_UNSURE:
            return None
        significant = abs(self.odds.offset) > max(ZERO_OFF, 3 * self.odds.offset_error)
        return self.odds.offset if significant else None

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
            "zero_offset_degrees": None if self.odds is None else self.odds.offset,
            "zero_offset_error_degrees": None if self.odds is None else self.odds.offset_error,
            "hypotheses": hypotheses,
            "sources": [
                {"source": e.source, "observations": e.observations, "usable": e.usable, "note": e.note}
                for e in self.sources
            ],
        }


def weigh(sources: Sequence[Evidence], pairing: int) -> Angles:
    """What the usable sources say together."""
    usable = [odds(evidence) for evidence in sources if evidence.usable]
    return Angles(pairing, tuple(sources), combined(usable) if usable else None)


def order_check(angles: Angles) -> Check:
    """Whether the pictures are called by the angles they were taken at."""
    key, title = "angle_order", "Order of the angles"
    if angles.odds is None:
        return Check(key, title, "n/a", _no_evidence(angles), _more_evidence(angles), figures=angles.record())
    best = angles.odds.best
    probability = angles.odds.probabilities[best]
    files = ORDERS[best].files(PAIRINGS[angles.pairing])
    if angles.order is None:
        rivals = [
            f"{', '.join(map(str, order.files(PAIRINGS[angles.pairing])))} ({p:.0%})"
            for order, p in sorted(zip(ORDERS, angles.odds.probabilities, strict=True), key=lambda t: -t[1])
            if p > 0.02
        ]
        return Check(
            key, title, "warning",
            f"Not decided. The pictures called 0, 45, 90, 135 were taken at {' or '.join(rivals)}.",
            _more_evidence(angles), figures=angles.record(),
        )  # fmt: skip
    if files == PAIRINGS[0]:
        said = f"As the files say, with a probability of {probability:.1%}."
        return Check(key, title, "ok", said, figures=angles.record())
    order = ",".join(map(str, files))
    return Check(
        key, title, "wrong", f"With a probability of {probability:.1%} {swaps(files)}.",
        f"{FIX}, or repeat prepare with --order {order}.", figures=angles.record(),
    )  # fmt: skip


def handedness_check(angles: Angles) -> Check:
    """Whether the angles count counter-clockwise as displayed."""
    key, title = "handedness", "Sense of the angles"
    if angles.odds is None:
        return Check(key, title, "n/a", _no_evidence(angles), _more_evidence(angles))
    probability = angles.odds.sense_probability
    figures = {"counter_clockwise": probability}
    if max(probability, 1 - probability) < DECIDED:
        said = f"Not decided: counter-clockwise with a probability of {probability:.0%}."
        return Check(key, title, "warning", said, _more_evidence(angles), figures=figures)
    if probability > 0.5:
        said = f"Counter-clockwise as displayed, with a probability of {probability:.1%}."
        return Check(key, title, "ok", said, figures=figures)
    return Check(
        key, title, "wrong", f"Clockwise as displayed, with a probability of {1 - probability:.1%}: a clockwise count, "
        "a mirrored picture, and two files that changed places look the same.",
        f"{FIX}, or repeat prepare with --sense cw (or the --order named above).", figures=figures,
    )  # fmt: skip


def zero_check(angles: Angles) -> Check:
    """Whether the zero of the angles is the image's horizontal."""
    key, title = "zero_offset", "Zero of the angles"
    if angles.odds is None:
        return Check(key, title, "n/a", _no_evidence(angles), _more_evidence(angles))
    offset, error = angles.odds.offset, angles.odds.offset_error
    figures = {"offset_degrees": offset, "error_degrees": error}
    if not math.isfinite(error) or error > ZERO_UNSURE:
        said = f"The zero is known only to {error:.1f}°."
        return Check(key, title, "warning", said, _more_evidence(angles), figures=figures)
    about = "" if angles.order in (None, IDENTITY) else " (beyond the order found above)"
    said = f"The zero of the instrument lies at {offset:+.1f}° ± {error:.1f}°{about}."
    verdict: Verdict = "ok"
    remedy = ""
    if abs(offset) > max(ZERO_OFF / 2, 3 * error):
        verdict = "wrong" if angles.offset is not None else "warning"
        remedy = f"{FIX}, or repeat prepare with --zero {offset:.1f}."
    return Check(key, title, verdict, said, remedy, figures=figures)


def _no_evidence(angles: Angles) -> str:
    said = " ".join(evidence.note for evidence in angles.sources)
    return (
        f"Geometry cannot judge it. {said}".strip()
        if said
        else "It takes poses, which the scene does not have."
    )


def _more_evidence(angles: Angles) -> str:
    if not angles.sources:
        return "Give the scene poses (polarguide prepare ... --poses sfm) and inspect it again."
    return (
        "Take views from more directions, also rolled or slanted ones, of curved glossy dielectrics; or train longer "
        "with --steps. A capture whose surfaces all face one way in the picture does not tell the sense, one without "
        "strong reflections not the quarter turn."
    )
