"""``exposures.svg``: scores over the pictures taken of each view, of ``compare --exposures``."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

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
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM, LINE = 400, 300, 46, 12, 26, 58, 18
APART = 9.0
"""Between the points of two scenes in one column, at most."""


class Point(NamedTuple):
    """A row of a scene's table: how many pictures were taken, and the score."""

    row: str
    pictures: int
    score: float


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
    """The scores of all rows of the tables, a panel for each metric, a column for each row, a color for each scene.

    Rows come in the order of the pictures they took, and of the tables where these are as many.

    Args:
        results: the record of a comparison. counts: by scene and row, the pictures taken.

    Returns:
        None where there is nothing to draw.
    """
    scenes = [scene["name"] for scene in results["scenes"]]
    rows = dict.fromkeys(row["recipe"] for row in results["table"])
    taken = {row: [counts[scene, row] for scene in scenes if (scene, row) in counts] for row in rows}
    columns = {row: numbers for row, numbers in sorted(taken.items(), key=lambda item: max(item[1]))}
    panels: list[str] = []
    for metric in DRAWN:
        points = {scene: _points(results, scene, metric.key, counts) for scene in scenes}
        if any(points.values()):
            left, top = len(panels) % 2 * WIDTH, len(panels) // 2 * HEIGHT
            panels.append(_panel(points, columns, metric.heading, left, top))
    if not panels:
        return None
    bottom = (len(panels) + 1) // 2 * HEIGHT
    legend = [
        f'<text x="{LEFT}" y="{bottom + LINE * number + 12}" fill="{PALETTE[number % len(PALETTE)]}">'
        f"{html.escape(scene)}</text>"
        for number, scene in enumerate(scenes)
    ]
    size = f"0 0 {WIDTH * min(2, len(panels))} {bottom + LINE * len(scenes) + 8}"
    style = "text{font:12px sans-serif}.grid{stroke:#8884}.frame{fill:#fff}.count{fill:#666;font-size:11px}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}"><style>{style}</style>'
    return "".join([head, '<rect class="frame" width="100%" height="100%"/>', *panels, *legend, "</svg>\n"])


def _points(results: Results, scene: str, key: str, counts: dict[tuple[str, str], int]) -> list[Point]:
    return [
        Point(row["recipe"], counts[scene, row["recipe"]], float(mean))
        for row in results["table"]
        if row["scene"] == scene and (mean := row["cells"][key]["mean"]) is not None
    ]


def _panel(
    points: dict[str, list[Point]], columns: Mapping[str, Sequence[int]], title: str, left: int, top: int
) -> str:
    scores = [point.score for of_scene in points.values() for point in of_scene]
    y_ticks = ticks(min(scores), max(scores))
    width = (WIDTH - LEFT - RIGHT) / len(columns)
    middles = {row: left + LEFT + width * (number + 0.5) for number, row in enumerate(columns)}
    floor = top + HEIGHT - BOTTOM

    def height(score: float) -> float:
        return floor - (HEIGHT - TOP - BOTTOM) * (score - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])

    def place(x: float, y: float) -> tuple[float, float]:
        return left + LEFT + (WIDTH - LEFT - RIGHT) * x, height(y)

    parts = [f'<text x="{left + LEFT}" y="{top + 16}">{html.escape(title)}</text>']
    parts += grid(place, (0.0, 1.0), y_ticks, numbered=False)
    for row, numbers in columns.items():
        spread = f"{min(numbers)}" if min(numbers) == max(numbers) else f"{min(numbers)} to {max(numbers)}"
        at = f'text-anchor="middle" x="{middles[row]:.1f}"'
        parts.append(f'<text {at} y="{floor + 18}">{html.escape(row)}</text>')
        parts.append(f'<text class="count" {at} y="{floor + 33}">{spread}</text>')
    center = left + (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text class="count" text-anchor="middle" x="{center:.1f}" y="{floor + 50}">training pictures</text>'
    )
    apart = min(APART, width / (len(points) + 1))
    for number, (scene, of_scene) in enumerate(points.items()):
        color, aside = PALETTE[number % len(PALETTE)], (number - (len(points) - 1) / 2) * apart
        for row, pictures, score in of_scene:
            said = f"{html.escape(scene)}, {html.escape(row)}, {pictures} pictures: {score:.2f}"
            parts.append(
                f'<circle cx="{middles[row] + aside:.1f}" cy="{height(score):.1f}" r="3.5" fill="{color}">'
                f"<title>{said}</title></circle>"
            )
    return "".join(parts)
