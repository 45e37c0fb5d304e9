"""What a training found out about the polarizers of its pictures: ``angles.csv`` of the run folder, and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from polarguide.capture import Scene
from polarguide.capture.angle_table import TABLE, table_text
from polarguide.capture.exposures import Exposure
from polarguide.capture.layout import find_layout
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError
from polarguide.files import write_text
from polarguide.progress import Reporter
from polarguide.training.polarizers import Judgment, Polarizers


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
    lines: list[tuple[str, str, Exposure, float | None]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            found = of.get((view.name, number))
            file = names[view.name][number]
            certainty = None if found is None else found.certainty
            lines.append((file, view.name, exposure if found is None else found.believed, certainty))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([_name(names, j) for j in chosen])})"

    sought = [judgment for judgment in judgments if not judgment.said.known]
    if sought:
        fitted = [judgment for judgment in sought if judgment.believed.angle is not None]
        middle = median(judgment.certainty for judgment in fitted) if fitted else 0.0
        reporter.say(
            f"angles found for {len(fitted)} of {len(sought)} pictures (median certainty {middle:.2f}, 1 is a filter, "
            f"0 none): {out / TABLE}"
        )
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
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {_name(names, first)} is said to be at "
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
