"""Curves of a controlled study: scores against the one number in which a family of scenes differs."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.curves import grid, ticks
from polarguide.experiments.results import Results
from polarguide.files import write_text

DRAWN = tuple(metric for metric in COLUMNS if metric.key in ("psnr", "normal_mae_deg"))
NAMES = {
    "views": "training views",
    "noise": "noise (1: exposed to full scale, 2: a quarter of that light)",
    "index": "refractive index",
    "spacing": "degrees between neighboring views",
}
"""What the parameters of a sweep are called at the axis, where their name does not say it."""
STUDY = "study.svg"
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM, ROW = 430, 330, 52, 14, 26, 44, 18
PALETTE = ("#3366cc", "#dc3912", "#109618", "#ff9900", "#990099", "#0099c6", "#dd4477", "#66aa00")

Point = tuple[float, float]


def read_study(scene: Path) -> tuple[str, float] | None:
    """The number under study that ``scene.json`` names, as (parameter, value), or None."""
    try:
        study = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["study"]
        return str(study["parameter"]), float(study["value"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_study(out: Path, results: Results, scenes: Mapping[str, Path]) -> None:
    """Write ``study.svg``, where the scenes (folders by name) are a family of ``polarguide synth --sweep``."""
    drawn = study_svg(results, {name: read_study(path) for name, path in scenes.items()})
    if drawn is not None:
        write_text(out / STUDY, drawn)


def study_svg(results: Results, studies: Mapping[str, tuple[str, float] | None]) -> str | None:
    """Every recipe's scores over the number under study, as an SVG file.

    Args:
        results: the record of a comparison.
        studies: by scene, what ``read_study`` found.

    Returns:
        None where the scenes are no family: fewer than two values, or different parameters.
    """
    found = {scene: study for scene, study in studies.items() if study is not None}
    parameters = {parameter for parameter, _ in found.values()}
    values = {scene: value for scene, (_, value) in found.items()}
    if len(found) < len(studies) or len(parameters) != 1 or len(set(values.values())) < 2:
        return None
    recipes = [recipe["name"] for recipe in results["recipes"]]
    panels: list[str] = []
    for metric in DRAWN:
        lines = {recipe: _line(results, recipe, metric.key, values) for recipe in recipes}
        if any(lines.values()):
            panels.append(_panel(lines, recipes, metric.heading, next(iter(parameters)), len(panels) * WIDTH))
    if not panels:
        return None
    legend = [
        f'<text x="{LEFT}" y="{HEIGHT + ROW * number + 12}" fill="{PALETTE[number % len(PALETTE)]}">'
        f"{html.escape(recipe)}</text>"
        for number, recipe in enumerate(recipes)
    ]
    size = f"0 0 {WIDTH * len(panels)} {HEIGHT + ROW * len(recipes) + 8}"
    style = "text{font:12px sans-serif}.grid{stroke:#8884}.frame{fill:#fff}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}"><style>{style}</style>'
    return "".join([head, '<rect class="frame" width="100%" height="100%"/>', *panels, *legend, "</svg>\n"])


def _line(results: Results, recipe: str, key: str, values: Mapping[str, float]) -> list[Point]:
    points = []
    for row in results["table"]:
        mean, value = row["cells"][key]["mean"], values.get(row["scene"] or "")
        if row["recipe"] == recipe and value is not None and mean is not None:
            points.append((value, float(mean)))
    return sorted(points)


def _panel(
    lines: Mapping[str, Sequence[Point]], recipes: Sequence[str], label: str, parameter: str, left: int
) -> str:
    points = [point for line in lines.values() for point in line]
    first, last = min(x for x, _ in points), max(x for x, _ in points)
    x_ticks = ticks(first if first > last / 2 else 0.0, last)
    y_ticks = ticks(min(y for _, y in points), max(y for _, y in points))

    def place(x: float, y: float) -> Point:
        across = (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])
        up = (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])
        return left + LEFT + (WIDTH - LEFT - RIGHT) * across, HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * up

    parts = [f'<text x="{left + LEFT}" y="16">{label}</text>']
    parts += grid(place, x_ticks, y_ticks)
    middle = left + (LEFT + WIDTH - RIGHT) / 2
    name, axis = html.escape(parameter), html.escape(NAMES.get(parameter, parameter))
    parts.append(f'<text text-anchor="middle" x="{middle:.1f}" y="{HEIGHT - 8}">{axis}</text>')
    for number, recipe in enumerate(recipes):
        color = PALETTE[number % len(PALETTE)]
        path = " ".join("{:.1f},{:.1f}".format(*place(x, y)) for x, y in lines[recipe])
        parts.append(f'<polyline fill="none" stroke="{color}" stroke-width="2" points="{path}"/>')
        for x, y in lines[recipe]:
            cx, cy = place(x, y)
            said = f"{html.escape(recipe)}, {name} {x:g}: {y:.2f}"
            parts.append(
                f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="3.5" fill="{color}"><title>{said}</title></circle>'
            )
    return "".join(parts)
