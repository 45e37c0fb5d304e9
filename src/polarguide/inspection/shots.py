"""Check captures of single shots: the kinds of their pictures, and the polarizer angles that they state.

A short training without the stated angles estimates the angle of each picture in closed form
(``training.angles.polarizers``). The estimates are compared with the stated angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from polarguide import optics
from polarguide.capture import Scene
from polarguide.capture.angle_evidence import (
    AngleEstimate,
    AngleLimits,
    CommonRotation,
    common_rotation,
    tolerance,
)
from polarguide.capture.exposures import Exposure, determine_stokes
from polarguide.capture.picture_sets import SetSamples, chosen_pixels, judge, typical_variance
from polarguide.capture.view import FULL_CODE, View, listed
from polarguide.inspection.capture import MEASURABLE, Capture
from polarguide.inspection.evidence import short_run, training_recipe
from polarguide.inspection.settings import LCD_TEST, Check, Verdict, first_outcome
from polarguide.raster import Backend
from polarguide.training.angles.polarizers import REMEDY, Judgment, Polarizers
from polarguide.training.settings import StepReport

RECIPE = "polarguide-stokes"
"""Name of the recipe of the short training that estimates the angles."""


class ShotLimits:
    """Thresholds of the checks of single shots.

    Attributes:
        certain: smallest modulation (``FittedAngle``) of a picture that can contradict its stated angle, relative to
            the median modulation. At 0.7 a wrong line of the demo (0.67) was not detected.
        contradicts: smallest difference in degrees that contradicts a stated angle. The short training has errors of 3
            to 7 degrees (median) on four scenes.
        sigmas: number of standard errors from which a difference is significant. See ``AngleLimits.sure``.
        fewest: smallest number of pictures with an estimated angle for a comparison.
        zero_off: offset in degrees, common to all angles, that causes a warning.
        zero_wrong: offset in degrees, common to all angles, for the verdict "wrong".
        redundant: smallest number of known angles in one view that can contradict each other.
        few_angles: smallest number of different angles in a capture that determines S1 and S2.
    """

    certain = 0.6
    contradicts = 30.0
    sigmas = 4.0
    fewest = 4
    zero_off = 4.0
    zero_wrong = 8.0
    redundant = 4
    few_angles = 3


CHAOS = (
    "Look for shifted lines in angles.csv, or prepare with --angles unknown: training then finds the angles."
)
"""Advice for stated angles that do not fit the pictures at all."""


@dataclass(frozen=True)
class ShotFindings:
    """Polarizer angles of the pictures, estimated by the short training.

    Attributes:
        judgments: result for each picture through a filter, estimated without its stated angle. Empty without a
            training.
        stated: exposure that the user stated, for each element of ``judgments``.
        why: reason why there was no training.
        unfiltered: True if no picture was taken through a filter.
    """

    judgments: tuple[Judgment, ...] = ()
    stated: tuple[Exposure, ...] = ()
    why: str = ""
    unfiltered: bool = False

    @property
    def determined(self) -> list[tuple[Judgment, float]]:
        """Results of the pictures whose angle could be estimated, each with the stated angle."""
        rows = zip(self.judgments, self.stated, strict=True)
        return [(judgment, s.angle) for judgment, s in rows if s.angle is not None and judgment.tells]

    @property
    def are_enough(self) -> bool:
        """True if the angles of enough pictures could be estimated for a comparison."""
        return len(self.determined) >= ShotLimits.fewest

    @property
    def rotation(self) -> CommonRotation:
        """Direction and zero of the stated angles, estimated from the pictures whose angle could be estimated."""
        if not self.are_enough:
            return CommonRotation()
        return common_rotation([j.angle for j, _ in self.determined], [angle for _, angle in self.determined])

    @property
    def undecided(self) -> tuple[Verdict, str]:
        """Verdict and finding of a check for which too few angles could be estimated."""
        if all(exposure.angle is None for exposure in self.stated):
            return "n/a", "No angle is stated: training estimates them."
        count = len(self.determined)
        return "not verified", f"Only {count} pictures with a stated angle determine it: too few to compare."

    def record(self) -> dict[str, Any]:
        """Return the findings as JSON types."""
        pictures = [
            {
                "view": judgment.view,
                "picture": judgment.number,
                "said_degrees": exposure.angle,
                "found_degrees": judgment.angle,
                "spread_degrees": judgment.spread,
                "gain": judgment.gain,
                "modulation": judgment.modulation,
                "filtered": not judgment.unfiltered,
                "tells": judgment.tells,
            }
            for judgment, exposure in zip(self.judgments, self.stated, strict=True)
        ]
        return {"pictures": pictures, "why_not": self.why}


def without_angles(scene: Scene) -> Scene:
    """Return a copy of the scene in which all pictures through a filter have unknown angles."""

    def blank(view: View) -> View:
        return view.with_exposures(tuple(replace(e, angle=None) if e.filtered else e for e in view.exposures))

    return replace(scene, views=tuple(blank(view) for view in scene.views))


def estimate_shot_angles(
    scene: Scene,
    *,
    steps: int,
    refractive_index: float,
    backend: Backend,
    on_step: Callable[[StepReport], None],
) -> ShotFindings:
    """Estimate the polarizer angle of every shot by a training that starts without known angles.

    Args:
        scene: scene at the size of the training. It needs training views.
        steps: approximate number of training steps.
        refractive_index: refractive index of the surfaces.
        backend: device and rasterizer.
        on_step: callback after every step.
    """
    if not any(exposure.filtered for view in scene.train_views for exposure in view.exposures):
        return ShotFindings(why="No picture was taken through a filter.", unfiltered=True)
    recipe = training_recipe(RECIPE)
    blind = without_angles(scene)
    total = math.ceil(steps / recipe.angle_rules.last)
    until = Polarizers(blind, recipe, total).search + 1  # the fit is done before the step
    state = short_run(
        blind,
        steps=total,
        until=until,
        recipe=recipe,
        refractive_index=refractive_index,
        backend=backend,
        on_step=on_step,
    )
    judgments = Polarizers(blind, recipe, total, state.angles).judgments()
    exposures = {view.name: view.exposures for view in scene.train_views}
    return ShotFindings(tuple(judgments), tuple(exposures[j.view][j.number] for j in judgments))


def pictures_check(capture: Capture) -> Check:
    """Check that there are enough pictures, and that their angles differ enough."""
    exposures = [exposure for view in capture.views for exposure in view.exposures]
    angles = sorted({exposure.angle for exposure in exposures if exposure.angle is not None})
    unknown = sum(not exposure.known for exposure in exposures)
    plain = sum(not exposure.filtered for exposure in exposures)
    known = len(exposures) - unknown - plain
    gains = [exposure.gain for exposure in exposures]
    figures = {"pictures": len(exposures), "angles": angles, "unknown": unknown, "plain": plain,
               "gains": [min(gains), max(gains)]}  # fmt: skip
    kinds = {
        f"{known} at {len(angles)} known angles ({listed([f'{angle:g}' for angle in angles])})": known,
        f"{unknown} at unknown angles": unknown,
        f"{plain} without a filter": plain,
    }
    finding = (
        f"{len(exposures)} pictures of {len(capture.views)} views: "
        f"{', '.join(text for text, count in kinds.items() if count)}; gains {min(gains):.2f} to {max(gains):.2f}."
    )
    outcome = first_outcome(
        (
            plain == len(exposures),
            "warning",
            f"{finding} Ordinary photographs train, without measured polarization.",
            "If a filter was used, state its angles (or --angles unknown) and repeat prepare. If not, nothing is "
            "wrong. Some views through a filter would improve layers and normals.",
        ),
        (
            not unknown and len(angles) < ShotLimits.few_angles,
            "warning",
            finding,
            "Rotate the filter between shots. At least three angles, spread over 180 degrees, measure all directions "
            "of the polarization.",
        ),
        (True, "ok", finding, ""),
    )
    return Check("pictures", *outcome, figures=figures)


def determined_sets(capture: Capture) -> Iterator[tuple[str, SetSamples]]:
    """Yield the name and the samples of each view whose known angles determine Stokes vectors."""
    for view in capture.views:
        places = [k for k, exposure in enumerate(view.exposures) if exposure.angle is not None]
        exposures = tuple(view.exposures[k] for k in places)
        if not determine_stokes(exposures):
            continue
        files = capture.layout.files(view.name)
        yield (
            view.name,
            SetSamples(
                labels=tuple(files[k].name for k in places),
                values=view.intensities()[places].numpy(),
                exposures=exposures,
                lost=np.broadcast_to(view.saturated.numpy(), (len(places), *view.saturated.shape)),
                dark=view.black.numpy(),
                masked=view.invalid.numpy(),
                step=1 / FULL_CODE,
            ),
        )


def strong_polarization(capture: Capture, index: float) -> list[float]:
    """Return the share of pixels with a DoLP above the limit of diffuse light, for each of ``determined_sets``.

    The DoLP has to exceed the limit by three times its noise, which is the residual of the fit. Views with three
    pictures are left out, because they have no residual. Dark pixels, see ``MEASURABLE``, do not count.

    Args:
        capture: the capture.
        index: refractive index.
    """
    limit = float(optics.diffuse_dolp_limit(index))
    shares = []
    for _, samples in determined_sets(capture):
        freedom = len(samples.labels) - 3
        if not freedom:
            continue
        gray = samples.gray(chosen_pixels(samples)).astype(np.float64)
        gray = gray[:, gray.mean(axis=0) >= MEASURABLE]
        if not gray.shape[1]:
            continue
        inverse = np.linalg.pinv(samples.rows.astype(np.float64))
        s0, s1, s2 = inverse @ gray
        squares = ((gray - samples.rows @ np.stack([s0, s1, s2])) ** 2).sum(axis=0)
        noise = math.sqrt(typical_variance(squares, freedom) * float((inverse[1:] ** 2).sum()) / 2)
        shares.append(float(np.mean(np.hypot(s1, s2) - 3 * noise > limit * s0)))
    return shares


def agreement_checks(capture: Capture) -> list[Check]:
    """Check that the pictures of a view agree with each other.

    Return an empty list if no view has four or more known angles.
    """
    compared = 0
    notes = []
    wrong: list[str] = []
    for name, samples in determined_sets(capture):
        if len(samples.labels) < ShotLimits.redundant:
            continue
        compared += 1
        judgment = judge(samples, samples.gray(chosen_pixels(samples)).astype(np.float64))
        if judgment.notes:
            wrong.append(name)
            notes += [f"{name}: {note.removesuffix(' It is left out.')}" for note in judgment.notes]
    if not compared:
        return []
    outcome = first_outcome(
        (not notes, "ok", f"The pictures of {compared} views agree.", ""),
        (
            notes,
            "wrong",
            f"In {len(wrong)} of {compared} views, pictures contradict each other. {listed(notes)}",
            "Correct their lines of angles.csv, or write unknown. Repeat prepare without pictures that moved.",
        ),
    )
    return [Check("agreement", *outcome, tuple(wrong), {"views": compared, "contradicting": len(wrong)})]


def shot_checks(findings: ShotFindings) -> list[Check]:
    """Check the filter, the direction and zero of the angles, and each single angle."""
    if findings.why:
        verdict: Verdict = "n/a" if findings.unfiltered else "not verified"
        return [
            Check(key, verdict, findings.why) for key in ("modulation", "handedness", "zero_offset", "angles")
        ]
    rotation = findings.rotation
    return [
        _modulation(findings),
        _sense(findings, rotation.sense),
        _zero(findings, rotation),
        _each(findings, rotation),
    ]


def _modulation(findings: ShotFindings) -> Check:
    count = len(findings.judgments)
    plain = tuple(dict.fromkeys(j.view for j in findings.judgments if j.unfiltered))
    vague = sum(j.vague for j in findings.judgments)
    modulation = float(np.median([j.modulation for j in findings.judgments]))
    finding = f"{count - len(plain) - vague} of {count} pictures determine the angle of their filter."
    outcome = first_outcome(
        (
            2 * len(plain) > count,
            "wrong",
            f"No modulation: was the filter reversed, or missing? {len(plain)} of {count} pictures look as if taken "
            "without one.",
            LCD_TEST,
        ),
        (
            plain,
            "warning",
            f"{finding} Probably taken without a filter: {listed(list(plain))}.",
            "If so, write none for them in angles.csv.",
        ),
        (
            2 * vague > count,
            "warning",
            f"{finding} The others have too little polarization.",
            "Photograph glossy surfaces obliquely (50 to 65 degrees); or train longer with --steps.",
        ),
        (True, "ok", finding, ""),
    )
    return Check(
        "modulation",
        *outcome,
        plain,
        {"pictures": count, "unfiltered": len(plain), "vague": vague, "modulation": modulation},
    )


def _sense(findings: ShotFindings, sense: int | None) -> Check:
    if not findings.are_enough:
        return Check("handedness", *findings.undecided)
    stated = np.radians([angle for _, angle in findings.determined])
    alike = max(abs(np.exp(1j * times * stated).mean()) for times in (2, 4)) > AngleLimits.same_direction
    outcome = first_outcome(
        (alike, "not verified", "The stated angles, modulo 90 degrees, differ too little to decide.", ""),
        (sense is None, "warning", "The pictures agree with neither sense.", CHAOS),
        (sense == 1, "ok", "Counter-clockwise as displayed.", ""),
        (
            sense == -1,
            "wrong",
            "Clockwise as displayed: the pictures agree only with the opposite sense.",
            "Repeat prepare with the other --sense and a new --out.",
        ),
    )
    return Check(
        "handedness",
        *outcome,
        figures={} if alike or sense is None else {"counter_clockwise": float(sense == 1)},
    )


def _zero(findings: ShotFindings, rotation: CommonRotation) -> Check:
    sense, offset, error = rotation
    if sense is None:
        return Check("zero_offset", *findings.undecided)
    finding = f"The zero of the filter differs from the stated one by {offset:+.1f}° ± {error:.1f}°."
    warning, wrong = (
        abs(offset) > tolerance(floor, error, sigmas=ShotLimits.sigmas)
        for floor in (ShotLimits.zero_off, ShotLimits.zero_wrong)
    )
    outcome = first_outcome(
        (not warning, "ok", finding, ""),
        (
            True,
            "wrong" if wrong else "warning",
            finding,
            f"Repeat prepare with --zero changed by {offset:+.0f} degrees and a new --out. This training has an error "
            "of a few degrees.",
        ),
    )
    return Check("zero_offset", *outcome, figures={"offset_degrees": offset, "error_degrees": error})


def _each(findings: ShotFindings, rotation: CommonRotation) -> Check:
    sense, offset, _ = rotation
    unknown = sum(not exposure.known for exposure in findings.stated)
    if sense is None:
        verdict, finding = findings.undecided
        doubtful = sum(j.doubtful for j in findings.judgments)
        doubts = verdict == "n/a" and 2 * doubtful > unknown
        outcome = first_outcome(
            (findings.are_enough, "wrong", "The pictures contradict the stated angles.", CHAOS),
            (
                doubts,
                "warning",
                f"No angle is stated, and {doubtful} of the {unknown} estimated angles are doubtful.",
                REMEDY,
            ),
            (True, "ok" if verdict == "n/a" else verdict, finding, ""),
        )
        return Check("angles", *outcome, figures={"doubtful": doubtful, "unknown": unknown} if doubts else {})
    rows = [
        (j, angle, AngleEstimate(j.angle, j.spread, sense * angle + offset, ShotLimits.contradicts))
        for j, angle in findings.determined
    ]
    typical = float(np.median([abs(estimate.off) for _, _, estimate in rows]))
    certain = ShotLimits.certain * float(np.median([j.modulation for j in findings.judgments]))
    off = [
        (j, angle)
        for j, angle, estimate in rows
        if replace(estimate, usual=typical, sigmas=ShotLimits.sigmas).contradicts
        and j.modulation > certain
        and not j.poorly_explained
    ]
    names = [f"{j.view} ({angle:g}°, looks like {sense * (j.angle - offset) % 180:.0f}°)" for j, angle in off]
    finding = f"The angles of {len(rows)} pictures differ by {typical:.1f}° from the stated angles (median)."
    outcome = first_outcome(
        (not off, "ok", finding, ""),
        (
            off,
            "wrong" if 5 * len(off) > len(rows) else "warning",
            f"{finding} Contradicting: {listed(names)}.",
            "Correct their lines of angles.csv, or write unknown.",
        ),
    )
    return Check(
        "angles",
        *outcome,
        tuple(dict.fromkeys(j.view for j, _ in off)),
        {"median_degrees": typical, "compared": len(rows), "unknown": unknown},
    )
