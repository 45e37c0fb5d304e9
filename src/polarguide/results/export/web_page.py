"""Export of a run as one web page: its texts, scores and initial view."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from polarguide.capture import View
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.results.evaluation.record import METRICS_FILE, read_metrics
from polarguide.results.evaluation.table import shown_metrics
from polarguide.results.export.presented import Presented
from polarguide.results.export.share import share_page
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult


def share(
    run: OpenedRun,
    path: PathLike | None = None,
    *,
    title: str = "",
    caption: str = "",
    reporter: Reporter = SILENT,
) -> Path:
    """Write a run as one self-contained web page that renders it with its reflections.

    The views of the page are the poses of the photographs. The page starts at the best view of the run.

    Args:
        run: the run; its scene is read.
        path: file to write, ending in .html; default: ``share.html`` in the run's folder.
        title: heading of the page; default: the title of the presentation or the scene's name.
        caption: text below the heading; default: the recipe and its steps. The kind of polarization is
            appended.
        reporter: receives a line about removed Gaussians.

    Returns:
        The path of the file.

    Raises:
        PolarguideError: the name has another suffix, or the scores cannot be read.
    """
    path = run.folder / "share.html" if path is None else Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise PolarguideError(
            "out", expected="a file name with the suffix .html", found=str(path), remedy="Change the suffix."
        )
    model = run.model
    views = run.scene.test_views + run.scene.train_views
    presented = Presented(run, reporter=reporter)
    scored = (run.folder / METRICS_FILE).exists()
    record = read_metrics(run.folder) if scored else None
    scores = [] if record is None else shown_metrics(record, scores_only=True)
    health = run.health
    first = _best_view(views, record, health)
    page = share_page(
        presented.gaussians,
        model.light,
        model.shading,
        {view.name: view.camera for view in views},
        first=first.name,
        title=title or presented.presentation.title or run.scene.name,
        caption=f"{caption or f'{run.recipe.name}, {run.steps:,} steps'} · polarization: {run.polarization}",
        metrics=[
            *((f"{label}, test views", text) for label, text in scores),
            ("Gaussians", f"{len(presented.gaussians['means']):,}"),
        ],
        notes=[f"Warning: {warning}" for warning in health.warnings] if health is not None else [],
        presentation=presented.presentation,
        footprints=presented.footprints,
        gloss=_gloss(run.result(first.camera, depth=False, within=presented.subject.holds)),
    )
    make_folder(path.parent)
    write_text(path, page)
    return path


def _best_view(views: Sequence[View], record: Mapping[str, Any] | None, health: Health | None) -> View:
    """Return the view with the highest PSNR in the scores or the training's health check, else the first view."""
    psnr: dict[str, float | None] = {}
    if record is not None:
        psnr = {name: scores["psnr"] for name, scores in record["views"].items()}
    elif health is not None:
        psnr = {name: view.psnr for name, view in health.views.items()}
    return max(views, key=lambda view: psnr.get(view.name) or 0.0)


MOST_GLOSS = 16.0
"""Maximum brightening of the specular layer. More would show the noise of dark surfaces."""


def _gloss(result: RenderResult) -> float:
    """Return the factor, a power of two, that brightens the specular layer so that at most 1 % of it clips."""
    if "specular" not in result.layers:
        return 1.0
    brightest = result.layers["specular"].amax(dim=-1)[result.alpha > 0.5].flatten()
    limit = float(brightest.quantile(0.99)) if brightest.numel() else 1.0
    return 2.0 ** math.floor(math.log2(min(max(1.0 / max(limit, 1e-6), 1.0), MOST_GLOSS)))
