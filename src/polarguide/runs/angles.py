"""What a training found out about the polarizers of its pictures: ``angles.csv`` of the run folder, and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from polarguide.angles.polarizers import REMEDY, Judgment, Polarizers
from polarguide.capture import Scene
from polarguide.capture.exposures import TABLE, Exposure, table_text
from polarguide.capture.layout import find_layout
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError
from polarguide.files import write_text
from polarguide.progress import Reporter

ANY = 90.0
"""Degrees: as far as two angles can be apart."""


def report_polarizers(out: Path, scene: Scene, polarizers: Polarizers, reporter: Reporter) -> None:
    """Write ``angles.csv``, which can take the place of the scene's own, and name what is doubtful.

    Args:
        out: the run folder. scene: the capture. polarizers: as the training leaves them.
        reporter: told a summary, and warned of pictures that contradict what is said of them.
    """
    judgments = polarizers.judgments()
    if not judgments:
        return
    names = picture_names(scene)
    of = {(judgment.view, judgment.number): judgment for judgment in judgments}
    lines: list[tuple[str, str, Exposure, float | None, str]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            file, found = names[view.name][number], of.get((view.name, number))
            if found is None:
                lines.append((file, view.name, exposure, None, ""))
                continue
            note = "doubtful" if found.doubtful and not found.said.known else ""
            lines.append((file, view.name, found.believed, found.modulation, note))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([_name(names, j) for j in chosen])})"

    sought = [judgment for judgment in judgments if not judgment.said.known]
    if sought:
        fitted = sum(judgment.believed.angle is not None for judgment in sought)
        doubtful = sum(judgment.doubtful for judgment in sought)
        reporter.say(
            f"angles found for {fitted} of {len(sought)} pictures; {doubtful} of {len(sought)} are doubtful: "
            f"{out / TABLE}"
        )
        if 2 * doubtful > len(sought):
            reporter.warn(f"Most angles are doubtful, and so are the layers and normals. {REMEDY}")
    vague = [judgment for judgment in sought if judgment.vague]
    if guessed := [judgment for judgment in vague if judgment.guesses]:
        reporter.warn(f"{named(guessed)} hardly tell their angle: the likeliest one is taken.")
    if lost := [judgment for judgment in vague if not judgment.guesses]:
        reporter.warn(f"{named(lost)} do not tell their angle and are taken for photographs.")
    if unsettled := [judgment for judgment in sought if judgment.unsettled]:
        reporter.warn(
            f"{named(unsettled)} may be at another angle: the fits of the training do not agree on it."
        )
    if poor := [judgment for judgment in sought if judgment.poorly_explained and not judgment.unsettled]:
        reporter.warn(
            f"{named(poor)} may be at another angle: the scene explains them worse than the others, and hardly better "
            "than a filter turned by 90 degrees would."
        )
    if plain := [judgment for judgment in judgments if judgment.unfiltered]:
        reporter.warn(
            f"{named(plain)} look as if taken without a filter, or through a circular one mounted the wrong way round."
        )
    known = [judgment for judgment in judgments if judgment.said.angle is not None]
    if known and all(judgment.limit >= ANY for judgment in known):
        reporter.say(
            f"known angles were not checked: the model predicts polarization too poorly (pictures look "
            f"{known[0].usual:.0f} degrees off in the median). polarguide inspect {scene.root} checks them by itself."
        )
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {_name(names, first)} is specified at "
            f"{first.said.words} degrees and looks as if at {first.angle:.0f}. Correct angles.csv."
        )


def picture_names(scene: Scene) -> dict[str, list[str]]:
    """The files of each view's pictures; where the scene was not read from such files, the view and a number."""
    try:
        layout = find_layout(scene.root)
    except PolarguideError:
        layout = None
    names = {}
    for view in scene.views:
        names[view.name] = [f"{view.name}#{number}" for number in range(len(view.exposures))]
        if layout is not None and view.name in layout.names and layout.exposures(view.name) == view.exposures:
            names[view.name] = [path.name for path in layout.files(view.name)]
    return names


def _name(names: dict[str, list[str]], judgment: Judgment) -> str:
    return names[judgment.view][judgment.number]
