"""Report of a comparison: one self-contained HTML file with tables, curves and pictures.

Its charts are SVG. They show training curves, and scores over a studied parameter or over the number of pictures.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

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
from polarguide.runs.folder import RunLog
from polarguide.runs.health import Health
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, ground_truth_pictures, layer_picture
from polarguide.visualization.pages import BASE, LAYERS, data_uri, page, page_part, templates
from polarguide_bench.gnerp.runs import FieldRun
from polarguide_bench.plan import Comparison, PlannedRun, SceneEntry, open_compared
from polarguide_bench.results import Results
from polarguide_bench.tables import BY_KEY, formatted, sections, seed_counts

Numbers = NDArray[np.float64]
POINTS = 240
"""Largest number of points of a curve."""
SMOOTHED_SHARE = 0.05
"""Width of the running mean of a curve, as a share of the training. Single steps are noisy, because views differ."""
DASHES = ("none", "7 4", "2 3")
"""Dash patterns of curves. After eight curves, the colors repeat with the next pattern."""
STUDIED = ("psnr", "normal_mae_deg")
"""Metrics that are drawn over a studied parameter."""
NAMES = {
    "views": "training views",
    "noise": "noise (1: exposed to full scale, 2: a quarter of that light)",
    "index": "refractive index",
    "spacing": "degrees between neighboring views",
}
"""Axis labels of studied parameters whose names are not clear."""
OVER_PICTURES = ("psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
"""Metrics that are drawn over the number of pictures."""
APART = 0.12
"""Horizontal distance between the points of two scenes in a column, as a share of the column's width."""


class Series(NamedTuple):
    """Points of one color: x, y, and the tooltip of each point. A point with an empty tooltip is not drawn."""

    name: str
    points: list[tuple[float, float, str]]


class Panel(NamedTuple):
    """Part of a chart: a pair of axes with its points.

    Attributes:
        title: title above the axes.
        axis: label of the x axis.
        series: points to draw, grouped by color.
        x_ticks: position and lines of text of each label at the x axis.
        x_ends: smallest and largest value of the x axis.
        y_ticks: numbers to label at the y axis.
    """

    title: str
    axis: str
    series: list[Series]
    x_ticks: list[tuple[float, list[str]]]
    x_ends: tuple[float, float]
    y_ticks: list[float]


def panel(title: str, axis: str, series: list[Series], columns: Sequence[list[str]] = ()) -> Panel:
    """Create a panel whose axes contain all points.

    Args:
        title: title above the axes.
        axis: label of the x axis.
        series: the points.
        columns: lines of text below the positions 0, 1, ... of the x axis. If empty, the axis is labeled with round
            numbers.
    """
    x, y, _ = zip(*(point for of in series for point in of.points), strict=True)
    y_ticks = ticks(min(y), max(y))
    if columns:
        x_ticks = [(float(place), lines) for place, lines in enumerate(columns)]
        return Panel(title, axis, series, x_ticks, (-0.5, len(columns) - 0.5), y_ticks)
    numbers = ticks(min(x) if min(x) > max(x) / 2 else 0.0, max(x))
    x_ticks = [(number, [f"{number:,g}"]) for number in numbers]
    return Panel(title, axis, series, x_ticks, (numbers[0], numbers[-1]), y_ticks)


def ticks(low: float, high: float) -> list[float]:
    """Return about six evenly spaced round numbers that enclose [low, high]."""
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
    """Draw panels as an SVG file. The legend defines the order of colors; ``size`` is width and height of a panel."""
    width, height = size
    return (
        templates(BASE)
        .get_template("chart.svg")
        .render(
            dashes=DASHES, panels=panels, legend=legend, lines=lines, label=label, width=width, height=height
        )
    )


class Curve(NamedTuple):
    """Training curve of a run.

    Attributes:
        name: name of the run.
        steps: [P] steps.
        seconds: [P] seconds.
        psnr: [P] smoothed PSNR of the training views in dB.
        held_out: [Q, 3] steps, seconds, and mean PSNR of a few held-out views. Q is 0 if none was scored.
    """

    name: str
    steps: Numbers
    seconds: Numbers
    psnr: Numbers
    held_out: Numbers


def read_curve(run: Path, name: str) -> Curve | None:
    """Read the training curve of a run from its log, with at most ``POINTS`` points.

    Return None for fewer than two points.
    """
    rows = RunLog(run).rows()
    steps, seconds, psnr = _logged(rows, "psnr").T
    if len(steps) < 2:
        return None
    index = np.unique(np.linspace(0, len(steps) - 1, POINTS).round().astype(int))
    means = smoothed(psnr, SMOOTHED_SHARE)[index]
    return Curve(name, steps[index], seconds[index], means, _logged(rows, "held_out"))


def _logged(rows: Sequence[Mapping[str, Any]], field: str) -> Numbers:
    """Return the number of finished steps, the seconds, and a field of the rows that have it, [P, 3]."""
    values = [(row["step"] + 1, row["seconds"], row[field]) for row in rows if row[field] is not None]
    return np.array(values, np.float64).reshape(-1, 3)


def smoothed(values: Numbers, share: float) -> Numbers:
    """Return the centered running mean of values over a window.

    ``share`` is the width of the window as a share of all values. Near both ends, the window is narrower so that it
    stays centered.
    """
    half = int(len(values) * share / 2)
    index = np.arange(len(values))
    reach = np.minimum(half, np.minimum(index, len(values) - 1 - index))
    sums = np.concatenate(([0.0], np.cumsum(values)))
    return np.asarray((sums[index + reach + 1] - sums[index - reach]) / (2 * reach + 1))


def curves_svg(curves: Sequence[Curve], axis: str) -> str:
    """Draw PSNR over ``axis`` ("steps" or "seconds") as an SVG element in the colors of the surrounding page.

    A second panel shows the held-out views if at least one curve has two points there.
    """
    series = [
        Series(c.name, [(x, y, "") for x, y in zip(getattr(c, axis), c.psnr, strict=True)]) for c in curves
    ]
    panels = [panel("PSNR (dB), training views", axis, series)]
    column = ("steps", "seconds").index(axis)
    held_out = [
        Series(c.name, [(p[column], p[2], f"{c.name}: {p[2]:.2f} dB") for p in c.held_out]) for c in curves
    ]
    if any(len(each.points) > 1 for each in held_out):
        panels.append(panel("PSNR (dB), a few held-out views", axis, held_out))
    return chart(panels, (), label=f"PSNR over {axis}", size=(860 // len(panels), 340))


def read_study(scene: Path) -> tuple[str, float] | None:
    """Read the studied parameter from ``scene.json``: its name and value, or None if the file has no parameter."""
    try:
        study = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["study"]
        return str(study["parameter"]), float(study["value"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def study_svg(results: Results, studies: Mapping[str, tuple[str, float] | None]) -> str | None:
    """Draw the scores of each recipe over the studied parameter.

    Args:
        results: the comparison.
        studies: result of ``read_study`` by scene.

    Returns:
        The chart, or None if the scenes are not a family of ``polarguide synth --sweep``. A family has one parameter
        with at least two values.
    """
    values = {scene: study[1] for scene, study in studies.items() if study is not None}
    parameters = {study and study[0] for study in studies.values()}
    if len(values) < len(studies) or len(parameters) != 1 or len(set(values.values())) < 2:
        return None
    name = str(parameters.pop())

    def point(scene: str, recipe: str) -> tuple[str, float, str]:
        return recipe, values[scene], f"{recipe}, {name} {values[scene]:g}"

    panels = _score_panels(results, STUDIED, NAMES.get(name, name), results.recipes, point)
    return chart(panels, results.recipes) if panels else None


def exposure_svg(results: Results, pictures: Mapping[tuple[str, str], int]) -> str | None:
    """Draw the scores over the number of pictures.

    The chart has a panel for each metric, a column for each row of the tables, and a color for each scene. Columns are
    sorted by the number of pictures, then as in the tables.

    Args:
        results: the comparison.
        pictures: number of pictures by scene and row.

    Returns:
        The chart, or None if there are no scores.
    """
    numbers = {row: [pictures[scene, row] for scene in results.scenes] for row in results.recipes}
    rows = sorted(numbers, key=lambda row: max(numbers[row]))
    columns = [[row, " to ".join(map(str, sorted({min(numbers[row]), max(numbers[row])})))] for row in rows]
    count = len(results.scenes)

    def point(scene: str, row: str) -> tuple[str, float, str]:
        offset = (results.scenes.index(scene) - (count - 1) / 2) * min(APART, 1 / (count + 1))
        return scene, rows.index(row) + offset, f"{scene}, {row}, {pictures[scene, row]} pictures"

    panels = _score_panels(results, OVER_PICTURES, "training pictures", results.scenes, point, columns)
    return chart(panels, results.scenes, lines=False) if panels else None


def _score_panels(
    results: Results,
    keys: Sequence[str],
    axis: str,
    names: Sequence[str],
    point: Callable[[str, str], tuple[str, float, str]],
    columns: Sequence[list[str]] = (),
) -> list[Panel]:
    """Create a panel for each metric that has scores.

    Args:
        results: the comparison.
        keys: keys of the metrics.
        axis: label of the x axis.
        names: names of the series.
        point: function that returns the series, the x position and the tooltip of a scene and a recipe.
        columns: see ``panel``.
    """
    panels = []
    for metric in (BY_KEY[key] for key in keys):
        table = results.scores.dropna(subset=["scene", metric.key])
        points: dict[str, list[tuple[float, float, str]]] = {name: [] for name in names}
        for scene, recipe, mean in zip(table["scene"], table["recipe"], table[metric.key], strict=True):
            name, x, text = point(scene, recipe)
            points[name].append((x, mean, f"{text}: {mean:.2f}"))
        if any(points.values()):
            series = [Series(name, sorted(of)) for name, of in points.items()]
            panels.append(panel(metric.heading, axis, series, columns))
    return panels


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
    curves: dict[str, list[Curve]] = {}
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
    curves: Mapping[str, Sequence[Curve]],
    remarks: Sequence[str] = (),
    sheets: Mapping[str, Sequence[tuple[str, str]]] = MappingProxyType({}),
    health: Sequence[str] = (),
) -> str:
    """Return the report as HTML with escaped texts.

    The page is self-contained, except for links to ``sheets``.

    Args:
        results: the comparison.
        views: views with pictures.
        curves: training curves of the recipes, by scene.
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
