"""The report of a comparison: one HTML file that needs nothing beside itself."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any

from polarguide.experiments.curves import COLORS, Curve, curves_svg, dash
from polarguide.experiments.results import Results
from polarguide.experiments.tables import Block, ShownCell, blocks, notes, shown_columns
from polarguide.visualization.embedded import LAYERS, EmbeddedView
from polarguide.visualization.figures import color_gradient

ERROR_HIGH = 0.25
"""Mean absolute difference of shown pictures that is brightest in the error map."""
NORMAL_ERROR_HIGH = 45.0
"""Degrees that are brightest in the map of normal errors."""
LEGEND = {
    "error": f"mean absolute difference over the channels, 0 to {ERROR_HIGH:g} of white",
    "normal_error": f"angle to the true normal, 0 to {NORMAL_ERROR_HIGH:g} degrees",
}
"""What the colors of false-color layers say."""


def report_html(
    results: Results,
    views: Sequence[EmbeddedView],
    curves: Mapping[str, Sequence[Curve]],
    remarks: Sequence[str] = (),
) -> str:
    """The page.

    Args:
        results: a record that passes ``validate_results``.
        views: the pictures.
        curves: by scene, those of its recipes.
        remarks: what was left out of the pictures or reduced, a sentence each.

    Returns:
        HTML; all names and texts in it are escaped, and it asks for nothing from outside.
    """
    scenes = ", ".join(scene["name"] for scene in results["scenes"])
    return Template(_page("report.html")).substitute(
        title=html.escape(f"Comparison on {scenes}"),
        style=_page("report.css"),
        script=_page("report.js"),
        summary=html.escape(_summary(results)),
        tables=_tables(results),
        notes=_list(notes(results)),
        pictures_hidden="" if views else "hidden",
        remarks=_list(remarks),
        gradient=color_gradient("inferno"),
        legend=_script_data(LEGEND),
        data=_script_data([vars(view) for view in views]),
        layers=_script_data(LAYERS),
        curves=_curves(results, curves),
        recipes=_recipes(results),
        provenance=_provenance(results),
    )


def _page(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text(encoding="utf-8")


def _summary(results: Results) -> str:
    settings, counts = results["settings"], {k: len(results[k]) for k in ("scenes", "recipes", "runs")}

    def plural(count: int, word: str) -> str:
        return f"{count:,} {word}{'' if count == 1 else 's'}"

    return ", ".join(
        (
            plural(counts["recipes"], "recipe"),
            plural(counts["scenes"], "scene"),
            plural(settings["seeds"], "seed"),
            f"{settings['steps']:,} steps a run",
        )
    )


def _script_data(data: Any) -> str:
    """JSON that cannot end the script element that holds it."""
    return json.dumps(data).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _list(texts: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in texts) + "</ul>" if texts else ""


def _tables(results: Results) -> str:
    headings = "".join(
        f"<th>{html.escape(column.label)}<br>{html.escape(' '.join((column.unit, column.arrow)))}</th>"
        for column in shown_columns(results)
    )
    return "".join(_table(block, headings) for block in blocks(results))


def _table(block: Block, headings: str) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(recipe)}</th>{''.join(map(_cell, cells))}</tr>" for recipe, cells in block.rows
    )
    return (
        f'<h3>{html.escape(block.title)}</h3><div class="scroll"><table><thead><tr><th>recipe</th>{headings}</tr>'
        f"</thead><tbody>{rows}</tbody></table></div>"
    )


def _cell(cell: ShownCell) -> str:
    value, spread = html.escape(cell.value), html.escape(cell.spread)
    value = f"<b>{value}</b>" if cell.best else value
    return f"<td>{value}{f' <small>± {spread}</small>' if spread else ''}</td>"


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
    facts = {**results["provenance"], **results["settings"]}
    rows = [
        (key.replace("_", " "), "unknown" if value is None else str(value)) for key, value in facts.items()
    ]
    rows += [
        (
            f"scene {s['name']}",
            f"{s['views']} views, test: {', '.join(s['test_views'])}; digest {s['digest'][:16]}",
        )
        for s in results["scenes"]
    ]
    return "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in rows)
