"""Check the polarizer angles of views with four pictures: their order, their direction, and their zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from polarguide.capture.angle_evidence import (
    IDENTITY,
    ORDERS,
    PAIRINGS,
    AngleLimits,
    FileOrder,
    Order,
    OrderEvidence,
    OrderPosterior,
    combine,
    posterior,
    swaps,
)
from polarguide.capture.calibration import Calibration, combined
from polarguide.capture.view import ANGLES
from polarguide.inspection.settings import Check, first_outcome

MOSAICS = {
    (1, 45): "--flip x (Reverse X), or --flip 90 (rotated counter-clockwise)",
    (1, 135): "--flip y (Reverse Y), or --flip 270 (rotated clockwise)",
    (1, 90): "--flip xy (Reverse X and Y), or --offset-x 1 --offset-y 1",
    (-1, 135): "--offset-x 1",
    (-1, 45): "--offset-y 1",
}
"""Options of ``prepare`` that correct a sensor's mosaics, by the direction and zero of their angles."""


class Hypothesis(NamedTuple):
    """One of the eight possible orders of the angles, with the probability that it is true.

    Attributes:
        order: direction ("sense") and zero of the angles.
        files: true angles of the pictures named 0, 45, 90 and 135.
        probability: posterior probability of the order.
        log_odds: logarithm of the odds of the most likely order to this order, 0 or more.
    """

    order: Order
    files: FileOrder
    probability: float
    log_odds: float


@dataclass(frozen=True, eq=False)
class AngleFindings:
    """Result of comparing the polarizer angles with the geometry of the scene.

    Attributes:
        pairing: pictures that belong to perpendicular angles, as an index into ``PAIRINGS``. It is found from sums of
            two pictures.
        sources: evidence from each source.
        posterior: result of all usable evidence together. None without usable evidence.
        applied: calibration that ``prepare`` applied. None for a scene that ``prepare`` did not write.
        mosaic: True if ``prepare`` developed mosaics of a sensor.
    """

    pairing: int
    sources: tuple[OrderEvidence, ...]
    posterior: OrderPosterior | None
    applied: Calibration | None = None
    mosaic: bool = False

    def correction(self, offset: float) -> str:
        """Return the advice for a decided order and an offset of the angles.

        It contains the complete new calibration, not the difference from the applied one.
        """
        if self.order is None or self.files is None:
            return ""
        applied = self.applied or Calibration()
        unchanged = applied.true_angles() == (ANGLES, 0.0) and abs(offset) <= AngleLimits.zero_off
        options = MOSAICS.get((self.order.sense, self.order.zero)) if self.mosaic and unchanged else None
        if options is not None:
            return (
                "A sensor's angles are fixed: the mosaics were mirrored or rotated, or their region starts elsewhere. "
                f"Repeat prepare with {options} and a new --out."
            )
        whole = combined(applied, Calibration(order=self.files, zero=round(offset, 1)))
        if whole is None:
            return "Repeat prepare without --order, --sense and --zero and with a new --out, and inspect the result."
        if self.applied is None:
            return (
                f"Write a corrected scene: polarguide prepare SCENE/polar --out NEW --poses SCENE {whole.options()}. "
                "Then copy split.json, gt and the entries polarizer, objects, materials and refractive_index of "
                "scene.json."
            )
        return (
            f"Repeat prepare with {whole.options()} and a new --out. This is the complete calibration; the scene was "
            f"prepared with {applied.options()}."
        )

    @property
    def order(self) -> Order | None:
        """Order of the angles, or None if it is not decided."""
        return None if self.posterior is None else self.posterior.order

    @property
    def files(self) -> FileOrder | None:
        """True angles of the pictures named 0, 45, 90 and 135, or None if they are not decided."""
        return None if self.order is None else self.order.files(PAIRINGS[self.pairing])

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """All possible orders with their probabilities. Empty without evidence."""
        if self.posterior is None:
            return []
        rows = zip(ORDERS, self.posterior.probabilities, self.posterior.log_odds, strict=True)
        return [Hypothesis(order, order.files(PAIRINGS[self.pairing]), p, odds) for order, p, odds in rows]

    @property
    def offset(self) -> float | None:
        """Offset of the zero relative to the order in degrees, or None if there is no significant offset."""
        zero = self.posterior
        if self.order is None or zero is None or not zero.is_precise or not zero.is_off(AngleLimits.zero_off):
            return None
        return zero.offset

    def record(self) -> dict[str, Any]:
        """Return the findings as JSON types."""
        hypotheses = [
            {
                "files": list(files),
                "sense": "ccw" if order.sense > 0 else "cw",
                "zero_degrees": order.zero,
                "probability": probability,
                "log_odds_against": log_odds,
            }
            for order, files, probability, log_odds in self.hypotheses
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
    sources: Sequence[OrderEvidence],
    pairing: int,
    applied: Calibration | None = None,
    *,
    mosaic: bool = False,
) -> AngleFindings:
    """Combine the usable sources of evidence on the polarizer angles.

    Args:
        sources: evidence from each source.
        pairing: index into ``PAIRINGS``, as in ``AngleFindings``.
        applied: calibration that ``prepare`` applied, as in ``AngleFindings``.
        mosaic: True if ``prepare`` developed mosaics of a sensor.
    """
    usable = [posterior(evidence) for evidence in sources if evidence.usable]
    return AngleFindings(pairing, tuple(sources), combine(usable) if usable else None, applied, mosaic)


def angle_checks(angles: AngleFindings) -> list[Check]:
    """Check the order, the direction and the zero of the angles."""
    more = "Prepare the scene with poses into a new folder (polarguide prepare ... --poses sfm --out NEW)."
    if angles.sources:
        more = (
            "Take views from more directions, including rolled or slanted ones, of curved glossy dielectrics; or train "
            "longer with --steps. The sense needs surfaces with different directions in the picture. The multiple of "
            "90 degrees needs strong reflections."
        )
    if angles.posterior is not None:
        checks = (_order_check, _sense_check, _zero_check)
        return [check(angles, angles.posterior, more) for check in checks]
    notes = " ".join(evidence.note for evidence in angles.sources)
    finding = f"Geometry does not decide it. {notes}" if notes else "This check needs poses."
    return [
        Check("angle_order", "not verified", finding, more, figures=angles.record()),
        *(Check(key, "not verified", finding, more) for key in ("handedness", "zero_offset")),
    ]


def _order_check(angles: AngleFindings, posterior: OrderPosterior, more: str) -> Check:
    """Check that the pictures are named by their true angles."""
    probability = max(posterior.probabilities)
    likely = sorted(
        (row for row in angles.hypotheses if row.probability > 0.02), key=lambda row: -row.probability
    )
    rivals = " or ".join(f"{', '.join(map(str, files))} ({p:.0%})" for _, files, p, _ in likely)
    outcome = first_outcome(
        (
            angles.files is None,
            "warning",
            f"Not decided. The pictures named 0, 45, 90, 135 were taken at {rivals}.",
            more,
        ),
        (
            angles.files == ANGLES,
            "ok",
            f"The file names are right with a probability of {probability:.1%}.",
            "",
        ),
        (
            True,
            "wrong",
            f"With a probability of {probability:.1%} {swaps(angles.files or ANGLES)}.",
            angles.correction(angles.offset or 0.0),
        ),
    )
    return Check("angle_order", *outcome, figures=angles.record())


def _sense_check(angles: AngleFindings, posterior: OrderPosterior, more: str) -> Check:
    """Check that the angles increase counter-clockwise as displayed."""
    probability = posterior.sense_probability
    outcome = first_outcome(
        (
            max(probability, 1 - probability) < AngleLimits.decided,
            "warning",
            f"Not decided: counter-clockwise with a probability of {probability:.0%}.",
            more,
        ),
        (
            probability > 0.5,
            "ok",
            f"Counter-clockwise as displayed, with a probability of {probability:.1%}.",
            "",
        ),
        (
            True,
            "wrong",
            f"Clockwise as displayed, with a probability of {1 - probability:.1%}. Clockwise angles, a mirrored "
            "picture and two exchanged files look the same.",
            angles.correction(angles.offset or 0.0) or more,
        ),
    )
    return Check("handedness", *outcome, figures={"counter_clockwise": probability})


def _zero_check(angles: AngleFindings, posterior: OrderPosterior, more: str) -> Check:
    """Check that a polarizer angle of 0 degrees is the image's horizontal."""
    offset = posterior.offset
    error = posterior.offset_error
    relation = "" if angles.order in (None, IDENTITY) else " (relative to the order above)"
    finding = f"The zero of the instrument is at {offset:+.1f}° ± {error:.1f}°{relation}."
    outcome = first_outcome(
        (
            not posterior.is_precise,
            "warning",
            f"The standard error of the zero is {error:.1f}°: too large to decide.",
            more,
        ),
        (not posterior.is_off(AngleLimits.zero_off / 2), "ok", finding, ""),
        (True, "warning" if angles.offset is None else "wrong", finding, angles.correction(offset) or more),
    )
    return Check("zero_offset", *outcome, figures={"offset_degrees": offset, "error_degrees": error})
