"""Report of a comparison: one self-contained HTML file with tables, curves and pictures."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import pandas as pd
import torch
from msgspec import UNSET

from polarguide.capture import Scene, View
from polarguide.capture.metadata import METAL_CLASSES
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.results.evaluation.metrics import normal_angles_deg
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, ground_truth_pictures, layer_picture
from polarguide.visualization.pages import LAYERS, data_uri, page, page_part
from polarguide_bench.figures import read_curve, training_curves
from polarguide_bench.gnerp.runs import FieldRun
from polarguide_bench.plan import Comparison, PlannedRun, SceneEntry, open_compared
from polarguide_bench.results import Results
from polarguide_bench.tables import BY_KEY, formatted, sections, seed_counts

SIDES = (1600, 1200, 800, 600, 400, 300, 200)
"""Candidates for the longest side of a picture, in pixels. The largest one that fits the size limit is used."""


class Tile(NamedTuple):
    """Group of pictures in the report: layers of one view, from one method or from the ground truth.

    Each layer has a picture and a line of scores.
    """

    name: str
    pictures: Mapping[str, Picture]
    scores: Mapping[str, str]


class EmbeddedView(NamedTuple):
    """View of a scene in the report, with pictures as data URIs.

    Attributes:
        scene: name of the scene.
        view: name of the view.
        width: width of the captured picture, which defines the aspect ratio of the tiles.
        height: height of the captured picture, for the same purpose.
        tiles: name of each tile, its layers as data URIs, and its lines of scores.
    """

    scene: str
    view: str
    width: int
    height: int
    tiles: tuple[tuple[str, dict[str, str], dict[str, str]], ...]


def embed(scene: str, view: str, tiles: Sequence[Tile], limit: int) -> tuple[EmbeddedView | None, str | None]:
    """Encode a view for the report, and reduce its pictures if necessary.

    Args:
        scene: name of the scene.
        view: name of the view.
        tiles: at least one tile. All pictures have the same size.
        limit: largest total size of the data URIs in bytes.

    Returns:
        Two values. The first is the view, or None if it does not fit into the limit. The second is a sentence if
        pictures were reduced or omitted, else None.
    """
    height, width = next(iter(tiles[0].pictures.values())).shape[:2]
    longest = max(height, width)
    for side in (longest, *(side for side in SIDES if side < longest)):
        encoded = tuple(
            (t.name, {key: data_uri(p, key, side) for key, p in t.pictures.items()}, dict(t.scores))
            for t in tiles
        )
        if sum(len(uri) for _, uris, _ in encoded for uri in uris.values()) <= limit:
            note = f"{scene}, {view}: pictures reduced from {longest} to {side} pixels."
            return EmbeddedView(scene, view, width, height, encoded), note if side < longest else None
    return None, f"{scene}, {view}: pictures left out, they would make the file too large."


def chosen_views(names: Sequence[str], count: int) -> list[str]:
    """Return at most ``count`` evenly spaced names, beginning with the first name."""
    count = min(count, len(names))
    return [names[index * len(names) // count] for index in range(count)]


REPORT = "report.html"
ERROR_SHEET = "errors.png"
"""Name of the file with error maps in a run folder."""
PICTURE_BYTES = 28_000_000
"""Largest total size of a report's pictures in bytes, for browsers and mail programs."""
LAYER_METRICS = {
    "final": "psnr",
    "diffuse": "diffuse_psnr",
    "specular": "specular_psnr",
    "normal": "normal_mae_deg",
    "error": "psnr",
    "normal_error": "normal_mae_deg",
}
"""Metric that is shown next to each layer."""
ERROR_HIGH = 0.25
"""Mean absolute difference of displayed pictures that is drawn at full brightness in an error map."""
NORMAL_ERROR_HIGH = 45.0
"""Angle in degrees that is drawn at full brightness in a map of normal errors."""
LEGEND = {
    "error": f"mean absolute difference over the channels, 0 to {ERROR_HIGH:g} of white",
    "normal_error": f"angle to the true normal, 0 to {NORMAL_ERROR_HIGH:g} degrees",
    "metalness": "share of metal, 0 to 1",
}
"""Explanation of the colors of each false-color layer."""


def write_report(
    comparison: Comparison,
    scenes: Sequence[SceneEntry],
    plan: Sequence[PlannedRun],
    results: Results,
    reporter: Reporter,
) -> None:
    """Render the pictures of the finished runs, and write ``report.html`` atomically."""
    views: list[EmbeddedView] = []
    remarks: list[str] = []
    curves: dict[str, dict[str, pd.DataFrame]] = {}
    sheets: dict[str, list[tuple[str, str]]] = {}
    finished = [run for run in plan if run.state() == "done"]
    for scene in scenes:
        # The run with the lowest seed of each row. It comes first in the plan.
        first = {run.row.name: run for run in reversed(finished) if run.scene.name == scene.name}
        runs = [first[row.name] for row in comparison.rows if row.name in first]
        sheets[scene.name] = [
            (run.row.name, (run.folder / ERROR_SHEET).relative_to(comparison.out).as_posix())
            for run in runs
            if (run.folder / ERROR_SHEET).exists()
        ]
        curves[scene.name] = {run.row.name: read_curve(run.folder) for run in runs}
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
    write_text(
        comparison.out / REPORT, report_html(results, views, curves, remarks, sheets, _health(finished))
    )


def _health(runs: Sequence[PlannedRun]) -> list[str]:
    """Return a line for each kind of polarization with its runs, and a line for each warning."""
    labels: dict[str, list[str]] = {}
    warnings = []
    for run in runs:
        polarization, own = recorded_health(run.folder)
        labels.setdefault(polarization or "not recorded, not checked", []).append(run.label)
        warnings += [f"{run.label}: {warning}" for warning in own]
    return [f"polarization {text}: {'; '.join(names)}" for text, names in labels.items()] + warnings


def _scene_views(
    comparison: Comparison, entry: SceneEntry, runs: Sequence[PlannedRun], names: Sequence[str], limit: int
) -> Iterator[tuple[EmbeddedView | None, str | None]]:
    """Yield the result of ``embed`` for each named view of a scene. ``limit`` is the limit of each view in bytes."""
    scene = read_scene(entry.path, comparison.options)
    device = comparison.options.device if comparison.options.local else "auto"
    opened = [open_compared(run.folder, device) for run in runs]
    scores = [(run.metrics() or {})["views"] for run in runs]
    for name in names:
        view = scene.view(name)
        rows = zip(runs, opened, scores, strict=True)
        tiles = [_tile(planned.row.name, run, view, s.get(name, {})) for planned, run, s in rows]
        yield embed(entry.name, name, [_ground_truth_tile(scene, view), *tiles], limit)


def _ground_truth_tile(scene: Scene, view: View) -> Tile:
    pictures = {key: value for key, value in ground_truth_pictures(view).items() if key in LAYER_METRICS}
    ids = None if view.ground_truth is None else view.ground_truth.object_ids
    metals = [item.id for item in scene.objects if item.material.kind in METAL_CLASSES]
    if ids is not None and metals:
        mask = torch.isin(ids, torch.tensor(metals, dtype=ids.dtype))
        pictures["metalness"] = figures.scalar_to_rgb(mask.float(), 0.0, 1.0, "inferno")
    return Tile("photograph" if view.ground_truth is None else "ground truth", pictures, {})


def _tile(name: str, run: OpenedRun | FieldRun, view: View, scores: Mapping[str, float | None]) -> Tile:
    """Render a view of a run as a tile with scores."""
    result = run.model.render(view.camera, surface=True).to("cpu")
    pictures = {
        layer: picture
        for layer in ("final", "diffuse", "specular", "normal")
        if (picture := layer_picture(result, layer, view.camera)) is not None
    }
    metalness = result.layers.get("metalness")
    if metalness is not None and bool(metalness.any()):
        pictures["metalness"] = figures.scalar_to_rgb(metalness, 0.0, 1.0, "inferno")
    pictures["error"] = figures.error_to_rgb(result.final, view.photograph(), ERROR_HIGH)
    ground_truth = view.ground_truth
    if ground_truth is not None and ground_truth.normal is not None and "normal" in result.layers:
        angles = normal_angles_deg(result.normal.cpu(), ground_truth.normal)
        if ground_truth.mask is not None:
            angles = torch.where(ground_truth.mask, angles, torch.nan)
        pictures["normal_error"] = figures.scalar_to_rgb(angles, 0.0, NORMAL_ERROR_HIGH, "inferno")
    lines = {
        layer: f"{formatted(value, BY_KEY[key])} {BY_KEY[key].unit}"
        for layer, key in LAYER_METRICS.items()
        if layer in pictures and (value := scores.get(key)) is not None
    }
    return Tile(name, pictures, lines)


def report_html(
    results: Results,
    views: Sequence[EmbeddedView],
    curves: Mapping[str, Mapping[str, pd.DataFrame]],
    remarks: Sequence[str] = (),
    sheets: Mapping[str, Sequence[tuple[str, str]]] = MappingProxyType({}),
    health: Sequence[str] = (),
) -> str:
    """Return the report as HTML with escaped texts.

    The page is self-contained, except for links to ``sheets``.

    Args:
        results: the comparison.
        views: views with pictures.
        curves: training curves (``read_curve``) by scene and recipe.
        remarks: sentences about omitted or reduced pictures.
        sheets: for each scene, recipes and paths of their error maps, relative to the page.
        health: sentences about the health of the trainings.
    """
    package = "polarguide_bench"
    # Metalness is a choice only if a run has found metal.
    metal = any("metalness" in pictures for view in views for _, pictures, _ in view.tiles[1:])
    return page(
        package,
        "report.html",
        script=page_part(package, "report.js"),
        title=f"Comparison on {', '.join(results.scenes)}",
        summary=_summary(results),
        sections=sections(results),
        views=[view._asdict() for view in views],
        layers={key: label for key, label in LAYERS.items() if metal or key != "metalness"},
        legend=LEGEND,
        remarks=remarks,
        sheets={scene: sheet for scene, sheet in sheets.items() if sheet},
        health=health,
        gradient=figures.color_gradient("inferno"),
        curves={scene: training_curves(drawn) for scene, drawn in curves.items() if drawn},
        recipes=[(r.name, r.about, json.dumps(r.data, indent=1)) for r in results.record.recipes],
        facts=_facts(results),
    )


def _summary(results: Results) -> str:
    record = results.record

    def plural(count: int, noun: str) -> str:
        return f"{count:,} {noun}{'' if count == 1 else 's'}"

    seeds = " or ".join(plural(count, "seed") for count in seed_counts(results))
    own = (
        ", if a row has no other number"
        if any(recipe.steps is not UNSET for recipe in record.recipes)
        else ""
    )
    counts = f"{plural(len(record.recipes), 'recipe')}, {plural(len(record.scenes), 'scene')}, {seeds}"
    return f"{counts}, {record.settings.steps:,} steps per run{own}"


def _without_folders(command: str) -> str:
    """Return a command line whose paths are shortened to file names, because folders are private."""
    try:
        return shlex.join(Path(word).name if "/" in word else word for word in shlex.split(command))
    except ValueError:  # an edited record
        return command


def _facts(results: Results) -> dict[str, str]:
    """Return the facts that the end of the report lists, by heading."""
    record = results.record
    facts = msgspec.to_builtins(record.provenance) | msgspec.to_builtins(record.settings)
    if facts["refractive_index"] is None:
        facts["refractive_index"] = "own index of each scene"
    facts["command"] = _without_folders(facts["command"])
    stated = {key.replace("_", " "): "unknown" if v is None else str(v) for key, v in facts.items()}
    for scene in record.scenes:
        index = scene.refractive_index
        own = "" if index is UNSET else f"; refractive index {index:g}"
        views = f"{scene.views} views, test: {', '.join(scene.test_views)}"
        stated[f"scene {scene.name}"] = f"{views}; digest {scene.digest[:16]}{own}"
    return stated


def recorded_health(run: Path) -> tuple[str | None, tuple[str, ...]]:
    """Read the kind of polarization and the warnings from a run's ``health.json``.

    Without the file, return None and no warnings. An invalid file becomes a warning, so that other runs are still
    reported.
    """
    try:
        health = Health.load(run)
    except PolarguideError as error:
        return None, (str(error),)
    return (None, ()) if health is None else (health.polarization.text, health.warnings)
