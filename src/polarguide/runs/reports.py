"""Reports of a finished training: polarizer angles and metals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from polarguide.capture import Scene
from polarguide.capture.exposures import TABLE, Exposure, table_text
from polarguide.capture.layout import find_layout
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.core.text import command
from polarguide.runs.model import GaussianModel
from polarguide.training.angles.polarizers import REMEDY, Judgment, Polarizers
from polarguide.training.metals.observations import blended, evenly
from polarguide.visualization.figures import contact_sheet, radiance_to_rgb, scalar_to_rgb, write_png

METALS_PICTURE = "metals.png"
"""File with the picture of metals in a run folder."""
METAL_VIEWS = 6
"""Most training views in that picture."""
ANY = 90.0
"""Degrees: as far as two angles can be apart."""


def report_polarizers(out: Path, scene: Scene, polarizers: Polarizers, reporter: Reporter) -> None:
    """Write ``angles.csv``, which can take the place of the scene's own, and name what is doubtful.

    Args:
        out: the run folder. scene: the capture. polarizers: as the training leaves them.
        reporter: receives a summary, and a warning for pictures that contradict their specified angles.
    """
    judgments = polarizers.judgments()
    if not judgments:
        return
    names = picture_files(scene)
    of = {(judgment.view, judgment.number): judgment for judgment in judgments}
    lines: list[tuple[str, str, Exposure, float | None, str]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            file = names[view.name][number]
            judged = of.get((view.name, number))
            if judged is None:
                lines.append((file, view.name, exposure, None, ""))
                continue
            note = "doubtful" if judged.doubtful and not judged.specified.known else ""
            lines.append((file, view.name, judged.believed, judged.modulation, note))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([_name(names, j) for j in chosen])})"

    sought = [judgment for judgment in judgments if not judgment.specified.known]
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
    for chosen, fault in (
        (
            [judgment for judgment in vague if judgment.guesses],
            "hardly determine their angle; the most likely one is used.",
        ),
        (
            [judgment for judgment in vague if not judgment.guesses],
            "do not determine their angle and are used as photographs.",
        ),
        (
            [judgment for judgment in sought if judgment.unsettled],
            "may be at another angle: the fits of the training do not agree on it.",
        ),
        (
            [judgment for judgment in sought if judgment.poorly_explained and not judgment.unsettled],
            "may be at another angle: the scene explains them worse than the others, and hardly better than a filter "
            "turned by 90 degrees would.",
        ),
        (
            [judgment for judgment in judgments if judgment.unfiltered],
            "look as if taken without a filter, or through a circular one mounted the wrong way round.",
        ),
    ):
        if chosen:
            reporter.warn(f"{named(chosen)} {fault}")
    specified = [judgment for judgment in judgments if judgment.specified.angle is not None]
    if specified and all(judgment.limit >= ANY for judgment in specified):
        reporter.say(
            f"known angles were not checked: the model predicts polarization too poorly (pictures look "
            f"{specified[0].usual:.0f} degrees off in the median). "
            f"{command('inspect', scene.root)} checks them by itself."
        )
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {_name(names, first)} is specified at "
            f"{first.specified.label} degrees and looks as if at {first.angle:.0f}. {command('inspect', scene.root)} "
            "compares all angles by themselves; correct the names of the files or angles.csv where it agrees."
        )


def report_metals(
    out: Path, scene: Scene, undecided: Tensor | None, model: GaussianModel, reporter: Reporter
) -> None:
    """Say what is metal and of what polarization cannot tell, and write ``metals.png`` with both.

    Args:
        out: the run folder. scene: the capture. undecided: see ``MetalSearch.undecided``; None: no report.
        model: the trained Gaussians. reporter: receives a summary.
    """
    if undecided is None:
        return
    gaussians = model.state.gaussians
    rasterize = model.backend.rasterize
    views = evenly(scene.train_views, METAL_VIEWS)
    kinds = [
        [blended(gaussians, values, view.camera, rasterize).cpu() for view in views]
        for values in (gaussians["metalness"], undecided.float())
    ]
    metal, open_ = (
        100 * float(torch.stack([(k > 0.5).float().mean() for k in kind]).mean()) for kind in kinds
    )
    if not metal and not open_:
        (out / METALS_PICTURE).unlink(missing_ok=True)
        return
    rows = [
        [radiance_to_rgb(view.photograph()), *(scalar_to_rgb(kind[row], 0.0, 1.0) for kind in kinds)]
        for row, view in enumerate(views)
    ]
    labels = ["photograph", "metal", "undecided"]
    write_png(out / METALS_PICTURE, contact_sheet(rows, [view.name for view in views], labels))
    advice = ". Click on what is metal in the viewer (Materials), and resume" if open_ else ""
    reporter.say(
        f"metals: {metal:.1f} % of the pixels; undecided, as polarization cannot tell: {open_:.1f} %, see "
        f"{out / METALS_PICTURE}{advice}"
    )


def picture_files(scene: Scene) -> dict[str, list[str]]:
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
