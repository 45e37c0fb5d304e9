"""The report of a comparison: one HTML file with tables, curves and pictures that needs nothing beside itself.

Its charts are SVG: training curves, scores over a number under study, and over the pictures taken.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import UNSET
from numpy.typing import NDArray

from polarguide.capture import Scene, View
from polarguide.capture.metadata import METAL_CLASSES
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.results.evaluation.metrics import normal_angles_deg
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide.runs.folder import RunLog
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture
from polarguide.visualization.pages import BASE, LAYERS, data_uri, page, page_part, templates
from polarguide_bench.gnerp.runs import FieldRun
from polarguide_bench.plan import Comparison, PlannedRun, SceneEntry, open_compared
from polarguide_bench.results import Results
from polarguide_bench.tables import formatted, sections, seed_counts

Numbers = NDArray[np.float64]
POINTS = 240
SMOOTHED_SHARE = 0.05
"""Share of a training over which a curve is averaged: single steps show single views, which differ by decibels."""
DASHES = ("none", "7 4", "2 3")
"""There are eight colors: further curves repeat them dashed, then dotted."""
STUDIED = ("psnr", "normal_mae_deg")
NAMES = {
    "views": "training views",
    "noise": "noise (1: exposed to full scale, 2: a quarter of that light)",
    "index": "refractive index",
    "spacing": "degrees between neighboring views",
}
"""What the parameters of a sweep are called at the axis, where their name does not say it."""
OVER_PICTURES = ("psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
APART = 0.12
"""Between the points of two scenes in one column, of its width."""


class Series(NamedTuple):
    """Points of one color: x, y, and the text under the pointer, empty for points that are not drawn."""

    name: str
    points: list[tuple[float, float, str]]


class Panel(NamedTuple):
    """One pair of axes: the places with words at the x axis and its ends, numbers at the y axis."""

    title: str
    axis: str
    series: list[Series]
    x_ticks: list[tuple[float, list[str]]]
    x_ends: tuple[float, float]
    y_ticks: list[float]


def panel(title: str, axis: str, series: list[Series], columns: Sequence[list[str]] = ()) -> Panel:
    """A panel that holds all its points.

    Args:
        columns: words at the places 0, 1, ... of the x axis; without any, it has round numbers.
    """
    points = [point for of in series for point in of.points]
    x, y, _ = zip(*points, strict=True)
    y_ticks = ticks(min(y), max(y))
    if columns:
        x_ticks = [(float(place), words) for place, words in enumerate(columns)]
        return Panel(title, axis, series, x_ticks, (-0.5, len(columns) - 0.5), y_ticks)
    numbers = ticks(min(x) if min(x) > max(x) / 2 else 0.0, max(x))
    x_ticks = [(number, [f"{number:,g}"]) for number in numbers]
    return Panel(title, axis, series, x_ticks, (numbers[0], numbers[-1]), y_ticks)


def ticks(low: float, high: float) -> list[float]:
    """Round numbers at equal distances that enclose [low, high], about six."""
    rough = max(high - low, 1e-6) / 6
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first = math.floor(low / step + 1e-9)
    last = math.ceil(high / step - 1e-9)
    return [round(index * step, 10) for index in range(first, max(last, first + 1) + 1)]


def chart(
    panels: Sequence[Panel],
    legend: Sequence[str],
    *,
    lines: bool = True,
    label: str = "scores",
    size: tuple[int, int] = (430, 330),
) -> str:
    """An SVG file, its colors in the order of the legend; ``size``: width and height of a panel."""
    template = templates(BASE).get_template("chart.svg")
    return template.render(
        dashes=DASHES, panels=panels, legend=legend, lines=lines, label=label, width=size[0], height=size[1]
    )


class Curve(NamedTuple):
    """PSNR in dB [P] over step and seconds [P] of one run, smoothed."""

    name: str
    steps: Numbers
    seconds: Numbers
    psnr: Numbers


def read_curve(run: Path, name: str) -> Curve | None:
    """The curve of a run by its log, at most ``POINTS`` points; None where there is no line to draw."""
    measured = [(row["step"], row.get("seconds"), row.get("psnr")) for row in RunLog(run).rows()]
    rows = [row for row in measured if None not in row]
    if len(rows) < 2:
        return None
    steps, seconds, psnr = np.array(rows, np.float64).T
    keep = np.unique(np.linspace(0, len(rows) - 1, POINTS).round().astype(int))
    return Curve(name, steps[keep] + 1, seconds[keep], smoothed(psnr, SMOOTHED_SHARE)[keep])


def smoothed(values: Numbers, share: float) -> Numbers:
    """Centered running mean over a share of all values; the window shrinks at both ends, so that it stays centered."""
    half = int(len(values) * share / 2)
    index = np.arange(len(values))
    reach = np.minimum(half, np.minimum(index, len(values) - 1 - index))
    sums = np.concatenate(([0.0], np.cumsum(values)))
    return np.asarray((sums[index + reach + 1] - sums[index - reach]) / (2 * reach + 1))


def curves_svg(curves: Sequence[Curve], axis: str) -> str:
    """An SVG element with PSNR over ``axis``, "steps" or "seconds", in the colors of the page that it is put into."""
    series = [
        Series(c.name, [(x, y, "") for x, y in zip(getattr(c, axis), c.psnr, strict=True)]) for c in curves
    ]
    panels = [panel("PSNR (dB), training views", axis, series)]
    return chart(panels, (), label=f"PSNR over {axis}", size=(860, 340))


def read_study(scene: Path) -> tuple[str, float] | None:
    """The number under study that ``scene.json`` names, as (parameter, value), or None."""
    try:
        study = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["study"]
        return str(study["parameter"]), float(study["value"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def study_svg(results: Results, studies: Mapping[str, tuple[str, float] | None]) -> str | None:
    """Every recipe's scores over the number under study.

    Args:
        studies: by scene, what ``read_study`` found.

    Returns:
        None where the scenes are no family of ``polarguide synth --sweep``: fewer than two values, or different
        parameters.
    """
    values = {scene: study[1] for scene, study in studies.items() if study is not None}
    parameters = {study and study[0] for study in studies.values()}
    if len(values) < len(studies) or len(parameters) != 1 or len(set(values.values())) < 2:
        return None
    name = str(parameters.pop())
    panels = []
    for metric in _metrics(STUDIED):
        series = [Series(recipe, []) for recipe in results.recipes]
        for scene, recipe, mean in _scores(results, metric):
            text = f"{recipe}, {name} {values[scene]:g}: {mean:.2f}"
            series[results.recipes.index(recipe)].points.append((values[scene], mean, text))
        if any(of.points for of in series):
            series = [Series(of.name, sorted(of.points)) for of in series]
            panels.append(panel(metric.heading, NAMES.get(name, name), series))
    return chart(panels, results.recipes) if panels else None


def exposure_svg(results: Results, pictures: Mapping[tuple[str, str], int]) -> str | None:
    """The scores of all rows of the tables, a panel for each metric, a column for each row, a color for each scene.

    Rows come in the order of the pictures they took, and of the tables where these are as many.

    Args:
        pictures: by scene and row, how many were taken.

    Returns:
        None where there is nothing to draw.
    """
    numbers = {row: [pictures[scene, row] for scene in results.scenes] for row in results.recipes}
    rows = sorted(numbers, key=lambda row: max(numbers[row]))
    columns = [[row, " to ".join(map(str, sorted({min(numbers[row]), max(numbers[row])})))] for row in rows]
    panels = []
    for metric in _metrics(OVER_PICTURES):
        series = [Series(scene, []) for scene in results.scenes]
        for scene, row, mean in _scores(results, metric):
            place = results.scenes.index(scene)
            x = rows.index(row) + (place - (len(series) - 1) / 2) * min(APART, 1 / (len(series) + 1))
            text = f"{scene}, {row}, {pictures[scene, row]} pictures: {mean:.2f}"
            series[place].points.append((x, mean, text))
        if any(of.points for of in series):
            panels.append(panel(metric.heading, "training pictures", series, columns))
    return chart(panels, results.scenes, lines=False) if panels else None


def _metrics(keys: Sequence[str]) -> list[Metric]:
    return [metric for key in keys for metric in COLUMNS if metric.key == key]


def _scores(results: Results, metric: Metric) -> list[tuple[str, str, float]]:
    """Scene, recipe and mean, where there is one."""
    table = results.scores.dropna(subset=["scene", metric.key])
    return list(zip(table["scene"], table["recipe"], table[metric.key], strict=True))


SIDES = (1600, 1200, 800, 600, 400, 300, 200)
"""Longest sides in pixels to try until a view fits its share of the file."""


class Tile(NamedTuple):
    """One method (or the ground truth) on one view: its layers, and its scores there as a line of text a layer."""

    name: str
    pictures: Mapping[str, Picture]
    scores: Mapping[str, str]


class EmbeddedView(NamedTuple):
    """One view of a scene with all its tiles as data URIs.

    Attributes:
        scene, view: names. width, height: those of the captured pictures, for the shape of the tiles.
        tiles: for each its name, its layers as data URIs, and its lines of scores.
    """

    scene: str
    view: str
    width: int
    height: int
    tiles: tuple[tuple[str, dict[str, str], dict[str, str]], ...]


def embed(scene: str, view: str, tiles: Sequence[Tile], limit: int) -> tuple[EmbeddedView | None, str | None]:
    """Encode one view, smaller if it has to be.

    Args:
        scene, view: names.
        tiles: at least one, of pictures of one size.
        limit: bytes that the data URIs may take.

    Returns:
        The view, or None if it does not fit; and a sentence on what was reduced or left out, or None.
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
    """At most ``count`` of the names, evenly spread, the first among them."""
    if count >= len(names):
        return list(names)
    return [names[index * len(names) // count] for index in range(count)]


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
        # By row, the run with the lowest seed, which comes first.
        first = {run.row.name: run for run in reversed(finished) if run.scene.name == scene.name}
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
    html = report_html(results, views, curves, remarks, sheets, _health(finished))
    write_text(comparison.out / REPORT, html)


def _health(runs: Sequence[PlannedRun]) -> list[str]:
    """Health of the trainings: the evidence behind the layers (equal runs in one line), and a line for each warning."""
    alike: dict[str, list[str]] = {}
    warnings = []
    for run in runs:
        polarization, own = recorded_health(run.folder)
        text = "not recorded, not checked" if polarization is None else polarization
        alike.setdefault(f"polarization {text}", []).append(run.label)
        warnings += [f"{run.label}: {warning}" for warning in own]
    return [f"{text}: {'; '.join(labels)}" for text, labels in alike.items()] + warnings


def _scene_views(
    comparison: Comparison, entry: SceneEntry, runs: Sequence[PlannedRun], names: Sequence[str], limit: int
) -> Iterator[tuple[EmbeddedView | None, str | None]]:
    """The named views of one scene, as ``embed`` gives them; ``limit`` in bytes for each."""
    scene = read_scene(entry.path, comparison.options)
    opened = [open_compared(run.folder, comparison.options.own_device) for run in runs]
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


def _tile(name: str, run: OpenedRun | FieldRun, view: View, scores: Mapping[str, float | None]) -> Tile:
    """The pictures of one view by a run called ``name``."""
    result = run.model.render(view.camera, surface=True).to("cpu")
    pictures: dict[str, Picture] = {}
    for layer in ("final", "diffuse", "specular", "normal"):
        picture = layer_picture(result, layer, view.camera)
        if picture is not None:
            pictures[layer] = picture
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
    package = "polarguide_bench"
    # Metalness can be chosen only where a run has found some.
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


def _without_folders(command: str) -> str:
    """A command with the names of files and folders alone: where they lie on a machine is nobody's business."""
    try:
        words = shlex.split(command)
    except ValueError:  # of a record that somebody has edited
        return command
    return shlex.join(Path(word).name if "/" in word else word for word in words)


def _facts(results: Results) -> dict[str, str]:
    """The facts at the end of the report, by heading."""
    record = results.record
    facts = msgspec.to_builtins(record.provenance) | msgspec.to_builtins(record.settings)
    if facts["refractive_index"] is None:
        facts["refractive_index"] = "that of each scene"
    facts["command"] = _without_folders(facts["command"])
    stated = {key.replace("_", " "): "unknown" if v is None else str(v) for key, v in facts.items()}
    for scene in record.scenes:
        index = (
            f"; refractive index {scene.refractive_index:g}" if scene.refractive_index is not UNSET else ""
        )
        views = f"{scene.views} views, test: {', '.join(scene.test_views)}"
        stated[f"scene {scene.name}"] = f"{views}; digest {scene.digest[:16]}{index}"
    return stated


def recorded_health(run: Path) -> tuple[str | None, tuple[str, ...]]:
    """The polarization and the warnings in a run's ``health.json``; None and no warnings without the file.

    A damaged file becomes a warning, so that other runs are still reported.
    """
    try:
        health = Health.load(run)
    except PolarguideError as error:
        return None, (str(error),)
    return (None, ()) if health is None else (health.polarization.text, health.warnings)
