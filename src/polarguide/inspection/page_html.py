"""Render an inspection as one HTML page without scripts or other files."""

from __future__ import annotations

import html
from collections.abc import Sequence
from string import Template

from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import ViewMeasurements
from polarguide.inspection.inspect import Inspection
from polarguide.inspection.layers import LAYERS, SHOT_LAYERS, Layer, layer_uris
from polarguide.inspection.shots import ShotFindings
from polarguide.inspection.verdict import Check, Verdict
from polarguide.progress import SILENT, Reporter
from polarguide.visualization import figures
from polarguide.visualization.embedded import content_policy, page_part

FILE = "inspection.html"
_CLASSES: dict[Verdict, str] = {
    "ok": "ok",
    "warning": "warning",
    "wrong": "wrong",
    "n/a": "na",
    "not verified": "unverified",
}


def inspection_html(found: Inspection, reporter: Reporter = SILENT) -> str:
    """The HTML page; all names and texts in it are escaped.

    Args:
        found: the findings.
        reporter: receives the progress.
    """
    capture = found.capture
    layers = LAYERS if capture.four else SHOT_LAYERS
    marked = {name for check in found.checks for name in check.views}
    tiles = []
    with reporter.track("drawing", len(capture.views)) as advance:
        for view, measured in zip(capture.views, found.measurements, strict=True):
            tiles.append(_tile(layer_uris(view, layers), layers, measured, view.name in marked))
            advance(len(tiles))
    posed = f"{len(capture.posed)} with a pose" if capture.model is not None else "no poses"
    width, height = capture.size
    return Template(page_part(__package__, "inspection.html")).substitute(
        policy=content_policy(),
        title=html.escape(f"Inspection of {capture.name}"),
        style=Template(page_part(__package__, "inspection.css")).substitute(switching=_switching(layers)),
        summary=html.escape(f"{len(capture.views)} views of {width} x {height} pixels, {capture.bits} bits; {posed}"),
        overall=found.verdict,
        overall_class=_CLASSES[found.verdict],
        checks="".join(map(_check_row, found.checks)),
        angles=_angles(found.angles) if isinstance(found.angles, AngleFindings) else _shots(found.angles),
        inputs="".join(
            f'<input type="radio" name="layer" id="layer-{layer.key}"{" checked" if not k else ""}>'
            for k, layer in enumerate(layers)
        ),
        labels="".join(f'<label for="layer-{layer.key}">{html.escape(layer.label)}</label>' for layer in layers),
        legends=_legends(layers),
        tiles="".join(tiles),
        figures=_figures(found.measurements),
        facts=_facts(found),
    )  # fmt: skip


def _switching(layers: Sequence[Layer]) -> str:
    """CSS rules that show the layer of the selected radio button."""
    return "\n".join(
        f"#layer-{layer.key}:checked ~ .tiles .{layer.key} {{ display: block; }}\n"
        f"#layer-{layer.key}:checked ~ .legend.{layer.key} {{ display: flex; }}\n"
        f"#layer-{layer.key}:checked ~ .switch label[for=layer-{layer.key}] "
        "{ background: var(--accent); color: #fff; }\n"
        f"#layer-{layer.key}:focus-visible ~ .switch label[for=layer-{layer.key}] "
        "{ outline: 2px solid var(--accent); outline-offset: 2px; }"
        for layer in layers
    )


def _badge(verdict: Verdict) -> str:
    return f'<span class="badge {_CLASSES[verdict]}">{verdict}</span>'


def _check_row(check: Check) -> str:
    return (
        f'<tr id="check-{html.escape(check.key)}"><td>{_badge(check.verdict)}</td><th>{html.escape(check.title)}</th>'
        f"<td>{html.escape(check.finding)}</td><td>{html.escape(check.remedy)}</td></tr>"
    )


def _angles(angles: AngleFindings) -> str:
    notes = "".join(
        f'<p class="note">{html.escape(e.source.capitalize())}{"" if e.usable else " (not used)"}: '
        f"{html.escape(e.note)}</p>"
        for e in angles.sources
    )
    if angles.posterior is None:
        return "<p>Not decided: this check needs poses and reflecting surfaces.</p>" + notes
    rows = []
    for k, row in enumerate(angles.hypotheses):
        files = ", ".join(f"{angle}°" for angle in row.files)
        mark = ' class="best"' if k == angles.posterior.best else ""
        said = "" if k == angles.posterior.best else f"{-row.log_odds:.1f}"
        p = row.probability
        rows.append(
            f"<tr{mark}><th>{files}</th><td>{html.escape(row.order.label)}</td><td>{p:.2%}</td>"
            f'<td><span class="bar"><i style="width:{100 * p:.1f}%"></i></span></td><td>{said}</td></tr>'
        )
    return (
        '<table class="odds"><thead><tr><th>true angles of pictures 0°, 45°, 90°, 135°</th><th>sense and zero</th>'
        "<th>probability</th><th></th><th>log-odds relative to the best</th></tr></thead><tbody>"
        + "".join(rows)
        + "</tbody></table>"
        + f'<p class="note">Zero offset beyond the best order: {angles.posterior.offset:+.2f}° ± '
        f"{angles.posterior.offset_error:.2f}°.</p>" + notes
    )


def _shots(found: ShotFindings) -> str:
    if found.why:
        return f"<p>{html.escape(found.why)}</p>"
    rows = []
    for judgment, said in zip(found.judgments, found.said, strict=True):
        tells = "without a filter, as it looks" if judgment.unfiltered else f"{judgment.angle:.0f}°"
        tells = "too little polarization to tell" if judgment.vague else tells
        rows.append(
            f"<tr><th>{html.escape(judgment.view)}</th><td>{html.escape(said.words)}</td><td>{tells}</td>"
            f"<td>{judgment.spread:.1f}°</td><td>{judgment.modulation:.2f}</td><td>{judgment.gain:.2f}</td></tr>"
        )
    return (
        "<p>A short training that was told no angle found these. It is good to a few degrees; training itself finds "
        'unknown angles more exactly.</p><details><summary>All pictures</summary><table class="odds"><thead><tr>'
        "<th>view</th><th>said</th><th>found</th><th>spread</th><th>modulation</th><th>gain</th></tr></thead><tbody>"
        + "".join(rows)
        + "</tbody></table></details>"
    )


def _legends(layers: Sequence[Layer]) -> str:
    parts = []
    for layer in layers:
        bar = ""
        if layer.ramp is not None:
            stops = figures.color_gradient(layer.ramp)
            bar = f'<span class="ramp" style="background:linear-gradient(90deg,{stops})"></span>'
        elif layer.key == "aolp":
            bar = figures.aolp_wheel()
        parts.append(f'<p class="legend {layer.key}">{bar}{html.escape(layer.legend)}</p>')
    return "".join(parts)


def _tile(uris: dict[str, str], layers: Sequence[Layer], measured: ViewMeasurements, marked: bool) -> str:
    name = html.escape(measured.view)
    captions = "".join(f'<span class="{la.key}">{html.escape(la.caption(measured))}</span>' for la in layers)
    pictures = "".join(
        f'<img class="{la.key}" src="{uris[la.key]}" alt="{name}, {html.escape(la.label)}">' for la in layers
    )
    kind = "tile marked" if marked else "tile"
    return f'<figure class="{kind}"><figcaption><b>{name}</b>{captions}</figcaption>{pictures}</figure>'


def _figures(measurements: tuple[ViewMeasurements, ...]) -> str:
    heads = ("view", "99 % under", "saturated", "invalid", "dark", "noise", "pair ratio", "sum error", "DoLP median",
             "DoLP 99 %", "polarized", "above diffuse limit")  # fmt: skip
    if any(r.exposures for r in measurements):
        return _shot_figures(measurements)
    rows = []
    for r in measurements:
        ratio = "n/a" if r.pair_ratio is None else f"{r.pair_ratio:.4f}"
        cells = (f"{r.bright:.3f}", f"{r.saturated:.2%}", f"{r.invalid:.2%}", f"{r.dark:.2%}", f"{r.noise_share:.2%}",
                 ratio, f"{r.sum_error:.2%}", f"{r.dolp[0]:.3f}", f"{r.dolp[1]:.3f}", f"{r.polarized:.1%}",
                 f"{r.above_limit:.1%}")  # fmt: skip
        rows.append(
            f"<tr><th>{html.escape(r.view)}</th>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        )
    return _table(heads, rows)


def _shot_figures(measurements: tuple[ViewMeasurements, ...]) -> str:
    rows = []
    for r in measurements:
        cells = (r.exposures or "0, 45, 90, 135", f"{r.bright:.3f}", f"{r.saturated:.2%}", f"{r.invalid:.2%}",
                 f"{r.dark:.2%}")  # fmt: skip
        rows.append(
            f"<tr><th>{html.escape(r.view)}</th>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        )
    return _table(("view", "pictures", "99 % under", "saturated", "invalid", "dark"), rows)


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    return f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"


def _facts(found: Inspection) -> str:
    capture, settings = found.capture, found.settings
    facts = {
        "transfer": capture.transfer,
        "box filter": f"{capture.factor} x {capture.factor} pixels",
        "refractive index": f"{found.index:g}",
        "normals": f"{settings.normals}, {settings.steps} steps if trained",
        "SHA-256 of the pictures": capture.digest,
    }
    return "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
