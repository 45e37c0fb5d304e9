"""The report of a comparison: one HTML file with tables, curves and pictures that needs nothing beside itself."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType

import msgspec
import torch
from msgspec import UNSET

from polarguide.capture import Scene, View
from polarguide.capture.ground_truth import METAL_CLASSES
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.experiments.charts import DASHES, Curve, curves_svg, read_curve
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry
from polarguide.experiments.results import Results
from polarguide.experiments.tables import formatted, sections, seed_counts
from polarguide.results.evaluation.metrics import normal_angles_deg
from polarguide.results.evaluation.table import COLUMNS
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture
from polarguide.visualization.pages import LAYERS, EmbeddedView, Tile, chosen_views, embed, page, page_part

REPORT = "report.html"
ERROR_SHEET = "errors.png"
"""What scoring writes into a run's folder where it draws the errors."""
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
ERROR_HIGH = 0.25
"""Mean absolute difference of shown pictures that is brightest in the error map."""
NORMAL_ERROR_HIGH = 45.0
"""Degrees that are brightest in the map of normal errors."""
LEGEND = {
    "error": f"mean absolute difference over the channels, 0 to {ERROR_HIGH:g} of white",
    "normal_error": f"angle to the true normal, 0 to {NORMAL_ERROR_HIGH:g} degrees",
    "metalness": "share of metal, 0 to 1",
}
"""What the colors of false-color layers say."""


def write_report(
    comparison: Comparison,
    scenes: Sequence[SceneEntry],
    plan: Sequence[PlannedRun],
    results: Results,
    reporter: Reporter,
) -> None:
    """Render the pictures of the finished runs and write ``report.html`` in one step."""
    views: list[EmbeddedView] = []
    remarks: list[str] = []
    curves: dict[str, list[Curve]] = {}
    sheets: dict[str, list[tuple[str, str]]] = {}
    finished = [run for run in plan if run.state() == "done"]
    for scene in scenes:
        first: dict[str, PlannedRun] = {}  # by row, the run with the lowest seed
        for run in finished:
            if run.scene.name == scene.name:
                first.setdefault(run.row.name, run)
        runs = [first[row.name] for row in comparison.rows if row.name in first]
        sheets[scene.name] = [
            (run.row.name, (run.folder / ERROR_SHEET).relative_to(comparison.out).as_posix())
            for run in runs
            if (run.folder / ERROR_SHEET).exists()
        ]
        read = (read_curve(run.folder, run.row.name) for run in runs)
        curves[scene.name] = [curve for curve in read if curve is not None]
        if not comparison.options.report_views or not runs:
            continue
        names = chosen_views(scene.test_views, comparison.options.report_views)
        if len(names) < len(scene.test_views):
            remarks.append(f"{scene.name}: {len(names)} of {len(scene.test_views)} test views are shown.")
        limit = PICTURE_BYTES // (len(scenes) * len(names))
        with reporter.track(f"report: pictures of {scene.name}", len(names)) as advance:
            drawn = enumerate(_scene_views(comparison, scene, runs, names, limit), start=1)
            for count, (view, remark) in drawn:
                views += [view] if view is not None else []
                remarks += [remark] if remark is not None else []
                advance(count)
    text = report_html(results, views, curves, remarks, sheets, _health(finished))
    write_text(comparison.out / REPORT, text)


def _health(runs: Sequence[PlannedRun]) -> list[str]:
    """Health of the trainings: the evidence behind the layers (equal runs in one line), and a line for each warning."""
    alike: dict[str, list[str]] = {}
    warnings = []
    for run in runs:
        health = Health.load(run.folder)
        text = "not recorded, not checked" if health is None else health.polarization.text
        alike.setdefault(f"polarization {text}", []).append(run.label)
        warnings += [f"{run.label}: {warning}" for warning in (() if health is None else health.warnings)]
    return [f"{text}: {'; '.join(labels)}" for text, labels in alike.items()] + warnings


def _scene_views(
    comparison: Comparison, entry: SceneEntry, runs: Sequence[PlannedRun], names: Sequence[str], limit: int
) -> Iterator[tuple[EmbeddedView | None, str | None]]:
    """The named views of one scene, as ``embed`` gives them; ``limit`` in bytes for each."""
    scene = read_scene(entry.path, comparison.options)
    opened = [OpenedRun.open(run.folder, device=comparison.options.own_device) for run in runs]
    scores = [(run.metrics() or {})["views"] for run in runs]
    for name in names:
        view = scene.view(name)
        tiles = [_ground_truth_tile(scene, view)]
        rows = zip(runs, opened, scores, strict=True)
        tiles += [_tile(planned.row.name, run, view, s.get(name, {})) for planned, run, s in rows]
        yield embed(entry.name, name, tiles, limit)


def _ground_truth_tile(scene: Scene, view: View) -> Tile:
    pictures = {key: value for key, value in ground_truth_pictures(view).items() if key in LAYER_METRICS}
    ids = None if view.ground_truth is None else view.ground_truth.object_ids
    metals = [item.id for item in scene.objects if item.material.kind in METAL_CLASSES]
    if ids is not None and metals:
        truly = torch.isin(ids, torch.tensor(metals, dtype=ids.dtype))
        pictures["metalness"] = figures.scalar_to_rgb(truly.float(), 0.0, 1.0, "inferno")
    return Tile(GROUND_TRUTH if view.ground_truth is not None else PHOTOGRAPH, pictures, {})


def _tile(name: str, run: OpenedRun, view: View, scores: Mapping[str, float | None]) -> Tile:
    """The pictures of one view by a run called ``name``."""
    result = run.model.render(view.camera, surface=True).to("cpu")
    pictures: dict[str, Picture] = {}
    for layer in ("final", "diffuse", "specular", "normal"):
        picture = layer_picture(result, layer, view.camera)
        if picture is not None:
            pictures[layer] = picture
    if result.metalness is not None and bool(result.metalness.any()):
        pictures["metalness"] = figures.scalar_to_rgb(result.metalness, 0.0, 1.0, "inferno")
    pictures["error"] = figures.error_to_rgb(result.final, view.photograph(), ERROR_HIGH)
    ground_truth = view.ground_truth
    if ground_truth is not None and ground_truth.normal is not None and result.normal is not None:
        angles = normal_angles_deg(result.normal.cpu(), ground_truth.normal)
        if ground_truth.mask is not None:
            angles = torch.where(ground_truth.mask, angles, torch.nan)
        pictures["normal_error"] = figures.scalar_to_rgb(angles, 0.0, NORMAL_ERROR_HIGH, "inferno")
    by_key = {metric.key: metric for metric in COLUMNS}
    lines = {
        layer: f"{formatted(value, by_key[key])} {by_key[key].unit}"
        for layer, key in LAYER_METRICS.items()
        if layer in pictures and (value := scores.get(key)) is not None
    }
    return Tile(name, pictures, lines)


def report_html(
    results: Results,
    views: Sequence[EmbeddedView],
    curves: Mapping[str, Sequence[Curve]],
    remarks: Sequence[str] = (),
    sheets: Mapping[str, Sequence[tuple[str, str]]] = MappingProxyType({}),
    health: Sequence[str] = (),
) -> str:
    """The page.

    Args:
        results: the comparison.
        views: the pictures.
        curves: by scene, those of its recipes.
        remarks: what was left out of the pictures or reduced, a sentence each.
        sheets: by scene, recipes and their pictures of errors, as paths from the page.
        health: what trainings say of themselves, a sentence each.

    Returns:
        HTML; all names and texts in it are escaped, and it asks for nothing from outside. It links to ``sheets``.
    """
    package = "polarguide.experiments"
    # Metalness can be chosen only where a run has found some.
    metal = any("metalness" in pictures for view in views for _, pictures, _ in view.tiles[1:])
    return page(
        package,
        "report.html",
        script=page_part(package, "report.js"),
        title=f"Comparison on {', '.join(results.scenes)}",
        summary=_summary(results),
        sections=sections(results),
        views=[vars(view) for view in views],
        layers={key: label for key, label in LAYERS.items() if metal or key != "metalness"},
        legend=LEGEND,
        remarks=remarks,
        sheets={scene: sheet for scene, sheet in sheets.items() if sheet},
        health=health,
        gradient=figures.color_gradient("inferno"),
        curves=[
            (scene, {axis: curves_svg(drawn, axis) for axis in ("steps", "seconds")}, [c.name for c in drawn])
            for scene, drawn in curves.items()
            if drawn
        ],
        dashes=DASHES,
        recipes=[(r.name, r.about, json.dumps(r.data, indent=1)) for r in results.record.recipes],
        facts=_facts(results),
    )


def _summary(results: Results) -> str:
    record = results.record

    def plural(count: int, word: str) -> str:
        return f"{count:,} {word}{'' if count == 1 else 's'}"

    seeds = " or ".join(plural(count, "seed") for count in seed_counts(results))
    own = (
        " unless a row says otherwise" if any(recipe.steps is not UNSET for recipe in record.recipes) else ""
    )
    counts = f"{plural(len(record.recipes), 'recipe')}, {plural(len(record.scenes), 'scene')}, {seeds}"
    return f"{counts}, {record.settings.steps:,} steps a run{own}"


def _facts(results: Results) -> dict[str, str]:
    """The facts at the end of the report, by heading."""
    record = results.record
    facts = msgspec.to_builtins(record.provenance) | msgspec.to_builtins(record.settings)
    if facts["refractive_index"] is None:
        facts["refractive_index"] = "that of each scene"
    stated = {key.replace("_", " "): "unknown" if v is None else str(v) for key, v in facts.items()}
    for scene in record.scenes:
        index = (
            f"; refractive index {scene.refractive_index:g}" if scene.refractive_index is not UNSET else ""
        )
        views = f"{scene.views} views, test: {', '.join(scene.test_views)}"
        stated[f"scene {scene.name}"] = f"{views}; digest {scene.digest[:16]}{index}"
    return stated
