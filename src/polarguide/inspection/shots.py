"""Captures of single shots: what their pictures are, and whether they agree with the angles that the capture states.

A short training without the stated angles estimates each picture's angle in closed form
(``training.angles.polarizers``), and the two are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.capture import Scene
from polarguide.capture.exposures import Exposure, determine_stokes
from polarguide.capture.picture_sets import SetSamples, chosen_pixels, judge
from polarguide.capture.view import FULL_CODE, View, listed
from polarguide.inspection.capture import Capture
from polarguide.inspection.evidence import short_run
from polarguide.inspection.settings import Check, Verdict
from polarguide.raster import Backend
from polarguide.recipes import recipe_named
from polarguide.training.angles.polarizers import REMEDY, Judgment, Polarizers
from polarguide.training.recipe import Recipe
from polarguide.training.settings import StepReport

RECIPE = "polarguide-stokes"
CERTAIN = 0.6
"""Modulation (``FittedAngle``), over the median of all pictures, from which one may contradict its stated angle. At
0.7 a wrong line of the demo (0.67) went unnamed. Nor may one that the scene explains poorly: on four test scenes with
right angles (two seeds each, 504 pictures) nine would count as wrong, five of them are certain enough, and none of
these is explained as well as the others.
"""
CONTRADICTS = 30.0
"""Degrees from the stated angle from which on a picture contradicts it, if that is also four times its spread and
four standard deviations of all differences. The short training is 3 to 7 degrees off (median) on four scenes."""
ALIKE = 0.8
"""Length of the mean of (cos 2d, sin 2d), d being differences of angles, from which on they agree with each other."""
FEWEST = 4
"""Number of pictures that determine their angle from which on all are judged."""
SENSE_NEEDS = 0.95
"""Said angles whose doubled directions have a mean longer than this are too much alike to tell a sense."""
ZERO_OFF = 4.0
"""Degrees of a common offset for a warning, if it is also beyond four standard errors."""
ZERO_WRONG = 8.0
"""Degrees of a common offset for the verdict "wrong"."""
REDUNDANT = 4
"""Known angles of one view from which on they can contradict one another."""
FEW_ANGLES = 3
"""Different angles from which on S1 and S2 can be told apart, over the capture."""


@dataclass(frozen=True)
class ShotFindings:
    """The polarizers of the pictures as the short training estimates them.

    Attributes:
        judgments: of each picture through a filter, without use of its stated angle; empty without a training.
        stated: the exposures as the capture states them, one each.
        why: why there was no training.
        unfiltered: whether that is because no picture was taken through a filter.
    """

    judgments: tuple[Judgment, ...] = ()
    stated: tuple[Exposure, ...] = ()
    why: str = ""
    unfiltered: bool = False

    @property
    def telling(self) -> list[tuple[Judgment, float]]:
        """Pictures that determine their angle, with the stated angle of each."""
        rows = zip(self.judgments, self.stated, strict=True)
        return [(j, s.angle) for j, s in rows if s.angle is not None and not (j.vague or j.unfiltered)]

    def record(self) -> dict[str, Any]:
        """As plain JSON types."""
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
                "tells": not (judgment.vague or judgment.unfiltered),
            }
            for judgment, exposure in zip(self.judgments, self.stated, strict=True)
        ]
        return {"pictures": pictures, "why_not": self.why}


def untold(scene: Scene) -> Scene:
    """The scene as if no angle of a picture through a filter were known."""

    def blank(view: View) -> View:
        return view.with_exposures(tuple(replace(e, angle=None) if e.filtered else e for e in view.exposures))

    return replace(scene, views=tuple(blank(view) for view in scene.views))


def find_shots(
    scene: Scene,
    folder: Path,
    *,
    steps: int,
    refractive_index: float,
    backend: Backend,
    on_step: Callable[[StepReport], None],
) -> ShotFindings:
    """Estimate the polarizer angle of every shot by a training that starts with no known angle.

    Args:
        scene: scene at the size to train at; it needs training views.
        folder: folder of the training's state, from which a stopped search resumes.
        steps: approximate number of training steps.
        refractive_index: refractive index of the surfaces.
        backend: device and rasterizer.
        on_step: function called after every step.
    """
    if not any(exposure.filtered for view in scene.train_views for exposure in view.exposures):
        return ShotFindings(why="No picture was taken through a filter.", unfiltered=True)
    recipe = recipe_named(RECIPE)
    assert isinstance(recipe, Recipe)
    blind = untold(scene)
    total = math.ceil(steps / recipe.angle_rules.last)
    until = Polarizers(blind, recipe, total).search + 1  # angles are fitted when a step begins
    state = short_run(
        blind,
        folder,
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
    """Check of the number of pictures, and of the differences of their angles."""
    key = "pictures"
    title = "Pictures"
    exposures = [exposure for view in capture.views for exposure in view.exposures]
    angles = sorted({exposure.angle for exposure in exposures if exposure.angle is not None})
    unknown = sum(not exposure.known for exposure in exposures)
    plain = sum(not exposure.filtered for exposure in exposures)
    known = len(exposures) - unknown - plain
    gains = [exposure.gain for exposure in exposures]
    figures = {"pictures": len(exposures), "angles": angles, "unknown": unknown, "plain": plain,
               "gains": [min(gains), max(gains)]}  # fmt: skip
    parts = []
    if known:
        parts.append(f"{known} at {len(angles)} known angles ({listed([f'{angle:g}' for angle in angles])})")
    if unknown:
        parts.append(f"{unknown} at unknown angles")
    if plain:
        parts.append(f"{plain} without a filter")
    finding = f"{len(exposures)} pictures of {len(capture.views)} views: {', '.join(parts)}; gains "
    finding += f"{min(gains):.2f} to {max(gains):.2f}."
    if plain == len(exposures):
        return Check(
            key, title, "warning", f"{finding} Ordinary photographs train, without measured polarization.",
            "If a filter was used, note its angles (or --angles unknown) and repeat prepare. If not, nothing is wrong; "
            "some views through a filter would improve layers and normals.", figures=figures,
        )  # fmt: skip
    if not unknown and len(angles) < FEW_ANGLES:
        return Check(
            key, title, "warning", finding,
            "Turn the filter between shots: with at least three angles, spread over half a turn, no direction of "
            "the polarization stays unseen.", figures=figures,
        )  # fmt: skip
    return Check(key, title, "ok", finding, figures=figures)


def agreement_checks(capture: Capture) -> list[Check]:
    """Whether the pictures of a view agree with one another; nothing where no view has more than three known angles."""
    key = "agreement"
    title = "Agreement of the angles"
    compared = 0
    notes = []
    wrong: list[str] = []
    for view in capture.views:
        places = [k for k, exposure in enumerate(view.exposures) if exposure.angle is not None]
        exposures = tuple(view.exposures[k] for k in places)
        if len(places) < REDUNDANT or not determine_stokes(exposures):
            continue
        files = capture.layout.files(view.name)
        samples = SetSamples(
            labels=tuple(files[k].name for k in places),
            values=view.codes[places].numpy(),
            exposures=exposures,
            lost=np.broadcast_to(view.saturated.numpy(), (len(places), *view.saturated.shape)),
            dark=view.black.numpy(),
            masked=view.invalid.numpy(),
            step=1 / FULL_CODE,
        )
        compared += 1
        judged = judge(samples, samples.gray(chosen_pixels(samples)).astype(np.float64))
        if judged.notes:
            wrong.append(view.name)
            notes += [f"{view.name}: {note.removesuffix(' It is left out.')}" for note in judged.notes]
    if not compared:
        return []
    figures = {"views": compared, "contradicting": len(wrong)}
    if not notes:
        return [Check(key, title, "ok", f"The pictures of {compared} views agree.", figures=figures)]
    return [
        Check(
            key, title, "wrong",
            f"In {len(wrong)} of {compared} views, pictures contradict one another. {listed(notes)}",
            "Correct their lines of angles.csv, or write unknown; repeat prepare without pictures that moved.",
            tuple(wrong), figures,
        )
    ]  # fmt: skip


def shot_checks(findings: ShotFindings) -> list[Check]:
    """Checks of the pictures: filter, sense and zero of the angles, and each angle."""
    if findings.why:
        checks = [("modulation", "Filter"), ("handedness", "Sense of the angles"),
                ("zero_offset", "Zero of the angles"), ("angles", "Angles of the pictures")]  # fmt: skip
        verdict: Verdict = "n/a" if findings.unfiltered else "not verified"
        return [Check(key, title, verdict, findings.why) for key, title in checks]
    sense, offset, error = _common(findings.telling)
    return [
        _modulation(findings),
        _sense(findings, sense),
        _zero(findings, sense, offset, error),
        _each(findings, sense, offset),
    ]


def _common(telling: Sequence[tuple[Judgment, float]]) -> tuple[int | None, float, float]:
    """Sense (1, or -1 for reversed; None where neither agrees), common offset in degrees, its standard error."""
    if len(telling) < FEWEST:
        return None, 0.0, math.inf
    angles = np.radians([(j.angle, s) for j, s in telling])
    turns = [np.exp(2j * (angles[:, 0] - sign * angles[:, 1])) for sign in (1, -1)]
    lengths = [abs(turn.mean()) for turn in turns]
    alike = abs(np.exp(2j * angles[:, 1]).mean()) > SENSE_NEEDS
    sense = 1 if lengths[0] >= lengths[1] or alike else -1
    turn = turns[0 if sense == 1 else 1]
    if abs(turn.mean()) < ALIKE / 2:
        return None, 0.0, math.inf
    # The mean, then once more without those that contradict it.
    near = turn[np.abs(np.angle(turn / turn.mean())) < math.radians(2 * CONTRADICTS)]
    offset = float(np.degrees(np.angle(near.mean())) / 2)
    apart = np.degrees(np.angle(near / near.mean())) / 2
    return sense, offset, float(1.4826 * np.median(np.abs(apart)) / math.sqrt(len(near)) * 1.25)


def _modulation(findings: ShotFindings) -> Check:
    key = "modulation"
    title = "Filter"
    count = len(findings.judgments)
    plain = tuple(dict.fromkeys(j.view for j in findings.judgments if j.unfiltered))
    vague = sum(j.vague for j in findings.judgments)
    modulation = float(np.median([j.modulation for j in findings.judgments]))
    figures = {"pictures": count, "unfiltered": len(plain), "vague": vague, "modulation": modulation}
    finding = f"{count - len(plain) - vague} of {count} pictures tell the angle of their filter."
    if 2 * len(plain) > count:
        return Check(
            key, title, "wrong",
            f"No modulation: was the filter reversed, or missing? {len(plain)} of {count} pictures look as if taken "
            "without one.",
            "Hold the filter before an LCD screen and turn it: the side that is towards the screen when it goes dark "
            "must face the scene. If the filter was right: photograph glossy surfaces obliquely (50 to 65 degrees).",
            plain, figures,
        )  # fmt: skip
    if plain:
        return Check(
            key, title, "warning", f"{finding} Taken without a filter, as it looks: {listed(list(plain))}.",
            "If so, write none for them in angles.csv.", plain, figures,
        )  # fmt: skip
    if 2 * vague > count:
        return Check(
            key, title, "warning", f"{finding} The others show too little polarization for that.",
            "Photograph glossy surfaces obliquely (50 to 65 degrees); or train longer with --steps.",
            figures=figures,
        )  # fmt: skip
    return Check(key, title, "ok", finding, figures=figures)


def _sense(findings: ShotFindings, sense: int | None) -> Check:
    key = "handedness"
    title = "Sense of the angles"
    telling = findings.telling
    if len(telling) < FEWEST:
        return Check(key, title, "n/a" if _all_unknown(findings) else "not verified", _too_few(findings))
    stated = np.radians([angle for _, angle in telling])
    if abs(np.exp(2j * stated).mean()) > SENSE_NEEDS or abs(np.exp(4j * stated).mean()) > SENSE_NEEDS:
        return Check(
            key,
            title,
            "not verified",
            "The stated angles, modulo 90 degrees, differ too little to tell.",
        )
    if sense is None:
        return Check(key, title, "warning", "The pictures agree with neither sense.", _remedy_of_chaos())
    if sense == -1:
        return Check(
            key, title, "wrong", "Clockwise as displayed: the pictures agree only if the angles count the other way.",
            "Repeat prepare with the other --sense and a new --out.", figures={"counter_clockwise": 0.0},
        )  # fmt: skip
    return Check(key, title, "ok", "Counter-clockwise as displayed.", figures={"counter_clockwise": 1.0})


def _zero(findings: ShotFindings, sense: int | None, offset: float, error: float) -> Check:
    key = "zero_offset"
    title = "Zero of the angles"
    if sense is None:
        return Check(key, title, "n/a" if _all_unknown(findings) else "not verified", _too_few(findings))
    figures = {"offset_degrees": offset, "error_degrees": error}
    finding = f"The zero of the filter lies at {offset:+.1f}° ± {error:.1f}° from where it is stated to lie."
    if abs(offset) <= max(ZERO_OFF, 4 * error):
        return Check(key, title, "ok", finding, figures=figures)
    verdict: Verdict = "wrong" if abs(offset) > max(ZERO_WRONG, 4 * error) else "warning"
    return Check(
        key, title, verdict, finding,
        f"Repeat prepare with --zero changed by {offset:+.0f} degrees and a new --out; this training itself is good "
        "to a few degrees.", figures=figures,
    )  # fmt: skip


def _each(findings: ShotFindings, sense: int | None, offset: float) -> Check:
    key = "angles"
    title = "Angles of the pictures"
    unknown = sum(not exposure.known for exposure in findings.stated)
    if sense is None:
        chaos = len(findings.telling) >= FEWEST
        if _all_unknown(findings) and (doubtful := sum(j.doubtful for j in findings.judgments)) * 2 > unknown:
            finding = f"No angle is specified, and {doubtful} of the {unknown} that were found are doubtful."
            return Check(
                key, title, "warning", finding, REMEDY, figures={"doubtful": doubtful, "unknown": unknown}
            )
        verdict: Verdict = "wrong" if chaos else "ok" if _all_unknown(findings) else "not verified"
        finding = "The pictures contradict the stated angles." if chaos else _too_few(findings)
        return Check(key, title, verdict, finding, _remedy_of_chaos() if chaos else "")
    # Differences are angles modulo 180 degrees, in [-90, 90).
    rows = [
        (j, (j.angle - sense * angle - offset + 90.0) % 180.0 - 90.0, angle) for j, angle in findings.telling
    ]
    typical = float(np.median([abs(apart) for _, apart, _ in rows]))
    certain = CERTAIN * float(np.median([j.modulation for j in findings.judgments]))
    off = [
        (j, angle)
        for j, apart, angle in rows
        if abs(apart) > max(CONTRADICTS, 4 * j.spread, 4 * 1.4826 * typical)
        and j.modulation > certain
        and not j.poorly_explained
    ]
    figures = {"median_degrees": typical, "compared": len(rows), "unknown": unknown}
    finding = f"{len(rows)} pictures lie {typical:.1f}° from the stated angles (median)."
    if not off:
        return Check(key, title, "ok", finding, figures=figures)
    names = [
        f"{j.view} ({angle:g}°, looks like {(sense * (j.angle - offset)) % 180:.0f}°)" for j, angle in off
    ]
    return Check(
        key, title, "wrong" if 5 * len(off) > len(rows) else "warning",
        f"{finding} Contradicting: {listed(names)}.",
        "Compare them with your notes; correct their lines of angles.csv, or write unknown.",
        tuple(dict.fromkeys(j.view for j, _ in off)), figures,
    )  # fmt: skip


def _all_unknown(findings: ShotFindings) -> bool:
    return all(exposure.angle is None for exposure in findings.stated)


def _too_few(findings: ShotFindings) -> str:
    if _all_unknown(findings):
        return "No angle is stated: training estimates them."
    count = len(findings.telling)
    return f"Only {count} pictures with a stated angle determine it: too few to compare."


def _remedy_of_chaos() -> str:
    return "Look for shifted lines in angles.csv, or prepare with --angles unknown: training then finds the angles."
