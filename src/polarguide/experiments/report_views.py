"""The pictures and curves of a comparison, rendered from its runs, and the report that shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.cli.common import OpenRun, console, open_run, read_scene
from polarguide.evaluation.metrics import normal_angles_deg
from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.curves import Curve, read_curve
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry
from polarguide.experiments.report import ERROR_HIGH, NORMAL_ERROR_HIGH, report_html
from polarguide.experiments.results import Results
from polarguide.experiments.tables import formatted
from polarguide.files import atomic
from polarguide.visualization import figures
from polarguide.visualization.embedded import EmbeddedView, Tile, chosen_views, embed
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture

REPORT = "report.html"
PICTURE_BYTES = 28_000_000
"""What all pictures of a report may take, so that the file stays one that can be mailed and opened."""
GROUND_TRUTH = "ground truth"
PHOTOGRAPH = "photograph"
LAYER_METRICS = {
    "final": "psnr",
    "diffuse": "diffuse_psnr",
    "specular": "specular_psnr",
    "normal": "normal_mae_deg",
    "error": "psnr",
    "normal_error": "normal_mae_deg",
}
"""Which score stands beside which layer."""


def write_report(
    comparison: Comparison,
    scenes: Sequence[SceneEntry],
    plan: Sequence[PlannedRun],
    results: Results,
) -> None:
    """Render the pictures of the finished runs and write ``report.html`` in one step."""
    views: list[EmbeddedView] = []
    remarks: list[str] = []
    curves: dict[str, list[Curve]] = {}
    for scene in scenes:
        shown = _first_finished(comparison, plan, scene)
        drawn = (read_curve(run.folder, run.recipe.name) for run in shown)
        curves[scene.name] = [curve for curve in drawn if curve is not None]
        if comparison.report_views and shown:
            names = chosen_views(scene.test_views, comparison.report_views)
            if len(names) < len(scene.test_views):
                remarks.append(f"{scene.name}: {len(names)} of {len(scene.test_views)} test views are shown.")
            limit = PICTURE_BYTES // (len(scenes) * len(names))
            _embed_scene(comparison, scene, shown, names, limit, views, remarks)
    with atomic(comparison.out / REPORT) as path:
        path.write_text(report_html(results, views, curves, remarks), encoding="utf-8")


def _first_finished(
    comparison: Comparison, plan: Sequence[PlannedRun], scene: SceneEntry
) -> list[PlannedRun]:
    """For every recipe the finished run with the lowest seed."""
    found: dict[str, PlannedRun] = {}
    for run in plan:
        if run.scene.name == scene.name and run.recipe.name not in found and run.state() == "done":
            found[run.recipe.name] = run
    return [found[recipe.name] for recipe in comparison.recipes if recipe.name in found]


def _embed_scene(
    comparison: Comparison,
    entry: SceneEntry,
    runs: Sequence[PlannedRun],
    names: Sequence[str],
    limit: int,
    views: list[EmbeddedView],
    remarks: list[str],
) -> None:
    """Append the views of one scene, and what there is to say about them."""
    console.print(f"report: pictures of {entry.name}")
    scene = read_scene(entry.path, downscale=comparison.downscale, transfer=comparison.transfer)
    opened = [open_run(run.folder, device=comparison.device, scene=scene) for run in runs]
    scores = [(run.metrics() or {})["views"] for run in runs]
    for name in names:
        tiles = [_truth_tile(scene, name)]
        tiles += [_tile(o, scene.view(name), s.get(name, {})) for o, s in zip(opened, scores, strict=True)]
        embedded, remark = embed(entry.name, name, tiles, limit)
        views += [embedded] if embedded is not None else []
        remarks += [remark] if remark is not None else []


def _truth_tile(scene: Scene, name: str) -> Tile:
    view = scene.view(name)
    pictures = {key: value for key, value in ground_truth_pictures(view).items() if key in LAYER_METRICS}
    return Tile(GROUND_TRUTH if view.ground_truth is not None else PHOTOGRAPH, pictures, {})


def _tile(opened: OpenRun, view: View, scores: Mapping[str, float | None]) -> Tile:
    """What one run shows of one view."""
    result = opened.render(view)
    pictures: dict[str, Picture] = {}
    for layer in ("final", "diffuse", "specular", "normal"):
        picture = layer_picture(result, layer, view.camera)
        if picture is not None:
            pictures[layer] = picture
    pictures["error"] = figures.error_to_rgb(result.final, view.photograph(), ERROR_HIGH)
    ground_truth = view.ground_truth
    if ground_truth is not None and ground_truth.normal is not None and result.normal is not None:
        angles = normal_angles_deg(result.normal.cpu(), ground_truth.normal)
        pictures["normal_error"] = _angles_picture(angles, ground_truth.mask)
    by_key = {metric.key: metric for metric in COLUMNS}
    lines = {
        layer: f"{formatted(value, by_key[key])} {by_key[key].unit}"
        for layer, key in LAYER_METRICS.items()
        if layer in pictures and (value := scores.get(key)) is not None
    }
    return Tile(opened.recipe.name, pictures, lines)


def _angles_picture(angles: Tensor, mask: Tensor | None) -> Picture:
    """Degrees [H, W] in false colors; black outside the mask and where there is no truth."""
    if mask is not None:
        angles = torch.where(mask, angles, torch.nan)
    return figures.scalar_to_rgb(angles, 0.0, NORMAL_ERROR_HIGH, "inferno")
