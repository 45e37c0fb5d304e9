"""``exposures.svg``: scores over the number of pictures taken, of ``compare --exposures``."""

from __future__ import annotations

import html
from collections.abc import Sequence

from polarguide.capture.variants import count_of
from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.curves import grid, ticks
from polarguide.experiments.plan import Comparison
from polarguide.experiments.results import Results
from polarguide.experiments.study import PALETTE
from polarguide.files import write_text

FIGURE = "exposures.svg"
KEYS = ("psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
DRAWN = tuple(metric for key in KEYS for metric in COLUMNS if metric.key == key)
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM, LINE = 400, 300, 46, 64, 26, 42, 18

Point = tuple[float, float, str]
"""Pictures taken, score, and the row of the tables."""


def write_exposure_figure(comparison: Comparison, results: Results) -> None:
    """Write ``exposures.svg``, where a comparison has several kinds of captures."""
    if len(comparison.options.exposures) < 2:
        return
    counts = {}
    for scene in results["scenes"]:
        views = scene["views"] - len(scene["test_views"])
        for row in comparison.rows:
            counts[scene["name"], row.name] = count_of(row.exposures, views)
    drawn = exposure_svg(results, counts)
    if drawn is not None:
        write_text(comparison.out / FIGURE, drawn)


def exposure_svg(results: Results, counts: dict[tuple[str, str], int]) -> str | None:
    """The scores of every row of the tables over the pictures it took, a panel for each metric, a color for each scene.

    Args:
        results: the record of a comparison. counts: by scene and row, the pictures taken.

    Returns:
        None where there is nothing to draw.
    """
    scenes = [scene["name"] for scene in results["scenes"]]
    panels: list[str] = []
    for metric in DRAWN:
        points = {scene: _points(results, scene, metric.key, counts) for scene in scenes}
        if any(points.values()):
            left, top = len(panels) % 2 * WIDTH, len(panels) // 2 * HEIGHT
            panels.append(_panel(points, metric.heading, left, top))
    if not panels:
        return None
    bottom = (len(panels) + 1) // 2 * HEIGHT
    legend = [
        f'<text x="{LEFT}" y="{bottom + LINE * number + 12}" fill="{PALETTE[number % len(PALETTE)]}">'
        f"{html.escape(scene)}</text>"
        for number, scene in enumerate(scenes)
    ]
    size = f"0 0 {WIDTH * min(2, len(panels))} {bottom + LINE * len(scenes) + 8}"
    style = "text{font:12px sans-serif}.name{font-size:11px}.grid{stroke:#8884}.frame{fill:#fff}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}"><style>{style}</style>'
    return "".join([head, '<rect class="frame" width="100%" height="100%"/>', *panels, *legend, "</svg>\n"])


def _points(results: Results, scene: str, key: str, counts: dict[tuple[str, str], int]) -> list[Point]:
    found = [
        (float(counts[scene, row["recipe"]]), float(mean), row["recipe"])
        for row in results["table"]
        if row["scene"] == scene and (mean := row["cells"][key]["mean"]) is not None
    ]
    return sorted(found)


def _panel(points: dict[str, list[Point]], title: str, left: int, top: int) -> str:
    every = [point for of_scene in points.values() for point in of_scene]
    x_ticks = ticks(0.0, max(x for x, _, _ in every))
    y_ticks = ticks(min(y for _, y, _ in every), max(y for _, y, _ in every))

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])
        up = (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])
        return (
            left + LEFT + (WIDTH - LEFT - RIGHT) * across,
            top + HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * up,
        )

    parts = [f'<text x="{left + LEFT}" y="{top + 16}">{html.escape(title)}</text>']
    parts += grid(place, x_ticks, y_ticks)
    middle = left + (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text text-anchor="middle" x="{middle:.1f}" y="{top + HEIGHT - 8}">pictures taken</text>')
    for number, (scene, of_scene) in enumerate(points.items()):
        color = PALETTE[number % len(PALETTE)]
        labels = _label_heights([place(x, y) for x, y, _ in of_scene])
        for (x, y, name), label in zip(of_scene, labels, strict=True):
            cx, cy = place(x, y)
            said = f"{html.escape(scene)}, {html.escape(name)}, {x:g} pictures: {y:.2f}"
            parts.append(
                f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="3.5" fill="{color}"><title>{said}</title></circle>'
                f'<text class="name" x="{cx + 6:.1f}" y="{label + 4:.1f}" fill="{color}">{html.escape(name)}</text>'
            )
    return "".join(parts)


def _label_heights(places: Sequence[tuple[float, float]], apart: float = 11.0) -> list[float]:
    """Heights of the labels of points, moved down where those of one column would lie on each other."""
    heights: dict[int, float] = {}
    for index in sorted(range(len(places)), key=lambda index: places[index][1]):
        x, y = places[index]
        taken = [heights[other] for other in heights if abs(places[other][0] - x) < 60]
        heights[index] = max([y, *(height + apart for height in taken if height + apart > y)])
    return [heights[index] for index in range(len(places))]
