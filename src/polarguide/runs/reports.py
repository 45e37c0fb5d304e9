"""Reports of a finished training: polarizer angles, metals, and the PLY of the Gaussians."""

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
from polarguide.runs.folder import PLY
from polarguide.runs.model import GaussianModel, write_run_ply
from polarguide.training.angles.fits import AngleFits
from polarguide.training.angles.polarizers import REMEDY, Judgment, Polarizers
from polarguide.training.callback import Callback
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.observations import blended, evenly
from polarguide.training.metals.search import MetalSearch
from polarguide.visualization.figures import contact_sheet, radiance_to_rgb, scalar_to_rgb, write_png

METALS_PICTURE = "metals.png"
"""File with the picture of metals in a run folder."""
METAL_VIEWS = 6
"""Largest number of training views in that picture."""
LARGEST_DIFFERENCE = 90.0
"""Largest difference of two polarizer angles, in degrees."""


def report_polarizers(out: Path, scene: Scene, polarizers: Polarizers, reporter: Reporter) -> None:
    """Write ``angles.csv`` in the format of a scene, and report doubtful angles.

    Args:
        out: the run folder.
        scene: the capture.
        polarizers: angles of the finished training.
        reporter: receives a summary, and a warning for pictures that contradict their specified angles.
    """
    judgments = polarizers.judgments()
    if not judgments:
        return
    names = picture_files(scene)
    by_picture = {(judgment.view, judgment.number): judgment for judgment in judgments}
    lines: list[tuple[str, str, Exposure, float | None, str]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            judged = by_picture.get((view.name, number))
            note = "doubtful" if judged and judged.doubtful and not judged.specified.known else ""
            believed, modulation = (judged.believed, judged.modulation) if judged else (exposure, None)
            lines.append((names[view.name][number], view.name, believed, modulation, note))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([names[j.view][j.number] for j in chosen])})"

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
    if specified and all(judgment.estimate.limit >= LARGEST_DIFFERENCE for judgment in specified):
        reporter.say(
            f"known angles were not checked: the model predicts polarization too poorly (pictures look "
            f"{specified[0].usual:.0f} degrees off in the median). "
            f"{command('inspect', scene.root)} checks them separately."
        )
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {names[first.view][first.number]} is specified at "
            f"{first.specified.label} degrees and looks as if at {first.angle:.0f}. {command('inspect', scene.root)} "
            "compares all angles separately; correct the names of the files or angles.csv where it agrees."
        )


def report_metals(
    out: Path, scene: Scene, undecided: Tensor | None, model: GaussianModel, reporter: Reporter
) -> None:
    """Report metals and undecided surfaces, and write ``metals.png`` with both.

    Args:
        out: the run folder.
        scene: the capture.
        undecided: see ``MetalSearch.undecided``; None: no report.
        model: the trained Gaussians.
        reporter: receives a summary.
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
    metal, unknown = (
        100 * float(torch.stack([(k > 0.5).float().mean() for k in kind]).mean()) for kind in kinds
    )
    if not metal and not unknown:
        (out / METALS_PICTURE).unlink(missing_ok=True)
        return
    rows = [
        [radiance_to_rgb(view.photograph()), *(scalar_to_rgb(kind[row], 0.0, 1.0) for kind in kinds)]
        for row, view in enumerate(views)
    ]
    labels = ["photograph", "metal", "undecided"]
    write_png(out / METALS_PICTURE, contact_sheet(rows, [view.name for view in views], labels))
    advice = ". Click on metal surfaces in the viewer (Materials), and resume" if unknown else ""
    reporter.say(
        f"metals: {metal:.1f} % of the pixels; not decided by polarization: {unknown:.1f} %, see "
        f"{out / METALS_PICTURE}{advice}"
    )


def picture_files(scene: Scene) -> dict[str, list[str]]:
    """Return the file names of each view's pictures; for a scene that is not read from such files, VIEW#NUMBER."""
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


class PolarizerReport(Callback[TrainingLoop]):
    """Report of the polarizer angles at the end of a training.

    Args:
        out: the run folder.
        fits: fits of the angles.
        reporter: receives the report.
    """

    def __init__(self, out: Path, fits: AngleFits, reporter: Reporter) -> None:
        self._out = out
        self._fits = fits
        self._reporter = reporter

    def at_end(self, loop: TrainingLoop) -> None:
        """Write the table and report."""
        report_polarizers(self._out, loop.context.scene, self._fits.polarizers, self._reporter)


class MetalReport(Callback[TrainingLoop]):
    """Report of the metals at the end of a training.

    Args:
        out: the run folder.
        reporter: receives the report.
    """

    def __init__(self, out: Path, reporter: Reporter) -> None:
        self._out = out
        self._reporter = reporter

    def at_end(self, loop: TrainingLoop) -> None:
        """Write the picture and report."""
        context = loop.context
        model = GaussianModel.of(loop.state, context.recipe, context.settings, context.backend)
        undecided = MetalSearch(loop.current).undecided(loop.state)
        report_metals(self._out, context.scene, undecided, model, self._reporter)


class PlyFile(Callback[TrainingLoop]):
    """PLY of the trained Gaussians in the run folder ``out``."""

    def __init__(self, out: Path) -> None:
        self._out = out

    def at_end(self, loop: TrainingLoop) -> None:
        """Write the file."""
        context = loop.context
        centers = torch.stack([view.camera.center for view in context.scene.views])
        write_run_ply(self._out / PLY, loop.state, context.shading, centers)
