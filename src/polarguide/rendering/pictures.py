"""Layers of a run's views as PNG files, with a contact sheet beside the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from polarguide.capture import Scene, View
from polarguide.errors import PolarguideError
from polarguide.files import make_folder
from polarguide.options import PathLike
from polarguide.progress import SILENT, Reporter
from polarguide.runs.opened import OpenedRun, checked_layers
from polarguide.visualization import figures
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture, true_depth_range
from polarguide.visualization.sheet import contact_sheet

SHEET_VIEWS = 8
CONTACT_SHEET = "contact_sheet.png"


def select_views(scene: Scene, choice: str) -> tuple[View, ...]:
    """The views of a choice: ``test``, ``train``, ``all``, or names separated by commas.

    Raises:
        PolarguideError: there is no such view, or none at all.
    """
    groups = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}
    names = [name.strip() for name in choice.split(",") if name.strip()]
    chosen = groups[choice] if choice in groups else tuple(scene.view(name) for name in names)
    if not chosen:
        raise PolarguideError(
            "views", expected="at least one view", found="none", remedy="Name a view, or take train."
        )
    return chosen


def write_pictures(
    run: OpenedRun,
    out: PathLike | None = None,
    *,
    views: str = "test",
    layers: Sequence[str] | None = None,
    reporter: Reporter = SILENT,
) -> Path:
    """Write layers of some views, one PNG each, and a contact sheet of them and the ground truth.

    Args:
        run: the run; its scene is read.
        out: folder to write; ``render`` in the run's folder by default.
        views: ``test``, ``train``, ``all``, or names separated by commas.
        layers: names of layers, all of the run's by default; one that the recipe has not is left out, and named to
            the reporter.

    Returns:
        The path of the contact sheet.

    Raises:
        PolarguideError: there is no such view or layer.
    """
    folder = run.folder / "render" if out is None else Path(out)
    names = checked_layers(list(run.layers if layers is None else layers))
    chosen = select_views(run.scene, views)
    make_folder(folder)
    rows: list[list[Picture | None]] = []
    labels: list[str] = []
    missing: set[str] = set()
    with reporter.track("rendering", len(chosen)) as advance:
        for number, view in enumerate(chosen):
            result = run.result(view.camera).to("cpu")
            depths = true_depth_range(view)
            pictures = {name: layer_picture(result, name, view.camera, depths) for name in names}
            for name, picture in pictures.items():
                if picture is None:
                    missing.add(name)
                else:
                    figures.write_png(folder / f"{view.name}_{name}.png", picture)
            ground_truth = ground_truth_pictures(view)
            if len(rows) < 2 * SHEET_VIEWS:
                rows.append([pictures[name] for name in names])
                rows.append([ground_truth.get(name) for name in names])
                labels += [view.name, f"{view.name} true"]
            advance(number + 1)
    sheet = folder / CONTACT_SHEET
    figures.write_png(sheet, contact_sheet(rows, labels, names))
    if missing:
        reporter.say(f"this recipe has no layer {', '.join(sorted(missing))}")
    return sheet
