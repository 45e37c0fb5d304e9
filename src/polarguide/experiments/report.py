"""The report of a comparison: one HTML file with tables, curves and pictures that needs nothing beside itself."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Mapping, Sequence
from string import Template
from types import MappingProxyType
from urllib.parse import quote

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.ground_truth import METAL_CLASSES
from polarguide.evaluation.metrics import normal_angles_deg
from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.curves import COLORS, Curve, curves_svg, dash, read_curve
from polarguide.experiments.forms import sections
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry
from polarguide.experiments.report_tables import list_html, section_html
from polarguide.experiments.results import Results
from polarguide.experiments.shown import formatted
from polarguide.experiments.tables import seed_counts
from polarguide.files import write_text
from polarguide.progress import Reporter
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures
from polarguide.visualization.embedded import (
    LAYERS,
    EmbeddedView,
    Tile,
    chosen_views,
    content_policy,
    embed,
    page_part,
    script_json,
)
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture

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
    health = _health([run for run in plan if run.state() == "done"])
    for scene in scenes:
        shown = _first_finished(comparison, plan, scene)
        drawn_errors = [(run.row.name, run.folder / ERROR_SHEET) for run in shown]
        sheets[scene.name] = [
            (name, path.relative_to(comparison.out).as_posix())
            for name, path in drawn_errors
            if path.exists()
        ]
        drawn = (read_curve(run.folder, run.row.name) for run in shown)
        curves[scene.name] = [curve for curve in drawn if curve is not None]
        if comparison.options.report_views and shown:
            names = chosen_views(scene.test_views, comparison.options.report_views)
            if len(names) < len(scene.test_views):
                remarks.append(f"{scene.name}: {len(names)} of {len(scene.test_views)} test views are shown.")
            limit = PICTURE_BYTES // (len(scenes) * len(names))
            with reporter.track(f"report: pictures of {scene.name}", len(names)) as advance:
                for done, (embedded, remark) in enumerate(
                    _scene_views(comparison, scene, shown, names, limit)
                ):
                    views += [embedded] if embedded is not None else []
                    remarks += [remark] if remark is not None else []
                    advance(done + 1)
    write_text(comparison.out / REPORT, report_html(results, views, curves, remarks, sheets, health))


def _health(runs: Sequence[PlannedRun]) -> list[str]:
    """What trainings say of themselves: what layers rest on, runs alike in a line, and a line for each warning."""
    alike: dict[str, list[str]] = {}
    warnings = []
    for run in runs:
        found = Health.load(run.folder)
        text = (
            "polarization not recorded, not checked"
            if found is None
            else f"polarization {found.polarization.text}"
        )
        alike.setdefault(text, []).append(run.label)
        warnings += [f"{run.label}: {warning}" for warning in (() if found is None else found.warnings)]
    return [f"{text}: {'; '.join(labels)}" for text, labels in alike.items()] + warnings


def _first_finished(
    comparison: Comparison, plan: Sequence[PlannedRun], scene: SceneEntry
) -> list[PlannedRun]:
    """For every recipe the finished run with the lowest seed."""
    found: dict[str, PlannedRun] = {}
    for run in plan:
        if run.scene.name == scene.name and run.row.name not in found and run.state() == "done":
            found[run.row.name] = run
    return [found[row.name] for row in comparison.rows if row.name in found]


def _scene_views(
    comparison: Comparison, entry: SceneEntry, runs: Sequence[PlannedRun], names: Sequence[str], limit: int
) -> Iterator[tuple[EmbeddedView | None, str | None]]:
    """The named views of one scene, as ``embed`` gives them; ``limit`` in bytes for each."""
    scene = read_scene(entry.path, comparison.options)
    opened = [OpenedRun.open(run.folder, device=comparison.options.device) for run in runs]
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
    """What a run, called ``name``, shows of one view."""
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
        pictures["normal_error"] = _angles_picture(angles, ground_truth.mask)
    by_key = {metric.key: metric for metric in COLUMNS}
    lines = {
        layer: f"{formatted(value, by_key[key])} {by_key[key].unit}"
        for layer, key in LAYER_METRICS.items()
        if layer in pictures and (value := scores.get(key)) is not None
    }
    return Tile(name, pictures, lines)


def _angles_picture(angles: Tensor, mask: Tensor | None) -> Picture:
    """Degrees [H, W] in false colors; black outside the mask and where there is no ground truth."""
    if mask is not None:
        angles = torch.where(mask, angles, torch.nan)
    return figures.scalar_to_rgb(angles, 0.0, NORMAL_ERROR_HIGH, "inferno")


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
        results: a record that passes ``validate_results``.
        views: the pictures.
        curves: by scene, those of its recipes.
        remarks: what was left out of the pictures or reduced, a sentence each.
        sheets: by scene, recipes and their pictures of errors, as paths from the page.
        health: what trainings say of themselves, a sentence each.

    Returns:
        HTML; all names and texts in it are escaped, and it asks for nothing from outside. It links to ``sheets``.
    """
    scenes = ", ".join(scene["name"] for scene in results["scenes"])
    script = page_part(__package__, "report.js")
    return Template(page_part(__package__, "report.html")).substitute(
        title=html.escape(f"Comparison on {scenes}"),
        style=page_part(__package__, "report.css"),
        script=script,
        policy=content_policy(script),
        summary=html.escape(_summary(results)),
        tables="".join(map(section_html, sections(results))),
        pictures_hidden="" if views else "hidden",
        remarks=list_html(remarks),
        sheets=_sheets(sheets),
        health=list_html(health),
        health_hidden="" if health else "hidden",
        gradient=figures.color_gradient("inferno"),
        legend=script_json(LEGEND),
        data=script_json([vars(view) for view in views]),
        layers=script_json(_layers(views)),
        curves=_curves(results, curves),
        recipes=_recipes(results),
        provenance=_provenance(results),
    )


def _layers(views: Sequence[EmbeddedView]) -> dict[str, str]:
    """Layers that one can choose; metalness only where a run has found some."""
    metal = any("metalness" in pictures for view in views for _, pictures, _ in view.tiles[1:])
    return {key: label for key, label in LAYERS.items() if metal or key != "metalness"}


def _summary(results: Results) -> str:
    settings, counts = results["settings"], {k: len(results[k]) for k in ("scenes", "recipes", "runs")}

    def plural(count: int, word: str) -> str:
        return f"{count:,} {word}{'' if count == 1 else 's'}"

    return ", ".join(
        (
            plural(counts["recipes"], "recipe"),
            plural(counts["scenes"], "scene"),
            " or ".join(plural(count, "seed") for count in seed_counts(results)),
            f"{settings['steps']:,} steps a run unless a row says otherwise"
            if any("steps" in recipe for recipe in results["recipes"])
            else f"{settings['steps']:,} steps a run",
        )
    )


def _sheets(sheets: Mapping[str, Sequence[tuple[str, str]]]) -> str:
    """Links to the pictures of errors beside the page, a line for each scene."""
    lines = [
        f"<li>{html.escape(scene)}: "
        + ", ".join(f'<a href="{html.escape(quote(path))}">{html.escape(name)}</a>' for name, path in found)
        + "</li>"
        for scene, found in sheets.items()
        if found
    ]
    if not lines:
        return ""
    return (
        f'<section id="sheets"><h2>Where the error is</h2><ul>{"".join(lines)}</ul>'
        '<p class="hint">Pictures in the folders of the runs, of the first finished seed: they open while these lie '
        "beside this page.</p></section>"
    )


def _curves(results: Results, curves: Mapping[str, Sequence[Curve]]) -> str:
    parts = []
    for scene, drawn in curves.items():
        if not drawn:
            continue
        legend = "".join(
            f'<li data-name="{html.escape(c.name)}"><svg class="key" viewBox="0 0 28 8">'
            f'<line class="curve c{i % COLORS}" {dash(i)} x1="1" x2="27" y1="4" y2="4"/></svg>'
            f"{html.escape(c.name)}</li>"
            for i, c in enumerate(drawn)
        )
        parts.append(
            f'<figure class="curves"><figcaption>{html.escape(scene)}</figcaption>'
            f'<div class="by-steps">{curves_svg(drawn, "steps")}</div>'
            f'<div class="by-seconds" hidden>{curves_svg(drawn, "seconds")}</div>'
            f'<ul class="legend">{legend}</ul></figure>'
        )
    return "".join(parts)


def _recipes(results: Results) -> str:
    return "".join(
        f"<details><summary><code>{html.escape(recipe['name'])}</code> {html.escape(recipe['about'])}</summary>"
        f"<pre>{html.escape(json.dumps(recipe['data'], indent=1))}</pre></details>"
        for recipe in results["recipes"]
    )


def _provenance(results: Results) -> str:
    facts: dict[str, object] = {**results["provenance"], **results["settings"]}
    if facts["refractive_index"] is None:
        facts["refractive_index"] = "that of each scene"
    rows = [
        (key.replace("_", " "), "unknown" if value is None else str(value)) for key, value in facts.items()
    ]
    rows += [
        (
            f"scene {s['name']}",
            f"{s['views']} views, test: {', '.join(s['test_views'])}; digest {s['digest'][:16]}"
            + (f"; refractive index {s['refractive_index']:g}" if "refractive_index" in s else ""),
        )
        for s in results["scenes"]
    ]
    return "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in rows)
