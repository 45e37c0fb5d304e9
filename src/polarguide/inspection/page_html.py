"""Render an inspection as one HTML page without scripts or other files."""

from __future__ import annotations

from collections.abc import Sequence

from polarguide.core.progress import SILENT, Reporter
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import ViewMeasurements
from polarguide.inspection.inspect import Inspection
from polarguide.inspection.layers import LAYERS, SHOT_LAYERS, layer_uris
from polarguide.inspection.shots import ShotFindings
from polarguide.visualization import figures
from polarguide.visualization.pages import page

FILE = "inspection.html"


def inspection_html(found: Inspection, reporter: Reporter = SILENT) -> str:
    """The HTML page; all names and texts in it are escaped.

    Args:
        found: the findings.
        reporter: receives the progress.
    """
    capture, settings, angles = found.capture, found.settings, found.angles
    layers = LAYERS if capture.four else SHOT_LAYERS
    marked = {name for check in found.checks for name in check.views}
    tiles = []
    with reporter.track("drawing", len(capture.views)) as advance:
        for view, measured in zip(capture.views, found.measurements, strict=True):
            uris = layer_uris(view, layers)
            pictures = [(layer, uris[layer.key], layer.caption(measured)) for layer in layers]
            tiles.append((measured.view, view.name in marked, pictures))
            advance(len(tiles))
    posed = f"{len(capture.posed)} with a pose" if capture.model is not None else "no poses"
    width, height = capture.size
    return page(
        "polarguide.inspection",
        "inspection.html",
        title=f"Inspection of {capture.name}",
        summary=f"{len(capture.views)} views of {width} x {height} pixels, {capture.bits} bits; {posed}",
        found=found,
        why=_why(angles),
        orders=_orders(angles) if isinstance(angles, AngleFindings) else [],
        shots=_shots(angles) if isinstance(angles, ShotFindings) else [],
        notes=_notes(angles) if isinstance(angles, AngleFindings) else [],
        layers=layers,
        ramps={layer.ramp: figures.color_gradient(layer.ramp) for layer in layers if layer.ramp},
        wheel=figures.aolp_wheel(),
        tiles=tiles,
        figures=_figures(found.measurements),
        facts={
            "transfer": capture.transfer,
            "box filter": f"{capture.factor} x {capture.factor} pixels",
            "refractive index": f"{found.index:g}",
            "normals": f"{settings.normals}, {settings.steps} steps if trained",
            "SHA-256 of the pictures": capture.digest,
        },
    )


def _why(angles: AngleFindings | ShotFindings) -> str:
    """Why nothing was found; empty where something was."""
    if isinstance(angles, ShotFindings):
        return angles.why
    return "" if angles.posterior else "Not decided: this check needs poses and reflecting surfaces."


def _orders(angles: AngleFindings) -> list[tuple[str, str, float, str]]:
    """Files, sense and zero, probability, and log-odds relative to the best (empty: the best)."""
    if angles.posterior is None:
        return []
    return [
        (
            ", ".join(f"{angle}°" for angle in row.files),
            row.order.label,
            row.probability,
            "" if k == angles.posterior.best else f"{-row.log_odds:.1f}",
        )
        for k, row in enumerate(angles.hypotheses)
    ]


def _notes(angles: AngleFindings) -> list[str]:
    found = angles.posterior
    zero = "" if found is None else f"{found.offset:+.2f}° ± {found.offset_error:.2f}°"
    notes = [f"Zero offset beyond the best order: {zero}."] if zero else []
    return notes + [
        f"{e.source.capitalize()}{'' if e.usable else ' (not used)'}: {e.note}" for e in angles.sources
    ]


def _shots(found: ShotFindings) -> list[tuple[str, ...]]:
    """Rows of the table of angles: what is specified of each picture, and what was found."""
    rows: list[tuple[str, ...]] = []
    for judgment, said in zip(found.judgments, found.said, strict=True):
        angle = "without a filter, as it looks" if judgment.unfiltered else f"{judgment.angle:.0f}°"
        angle = "too little polarization to tell" if judgment.vague else angle
        numbers = (f"{judgment.spread:.1f}°", f"{judgment.modulation:.2f}", f"{judgment.gain:.2f}")
        rows.append((judgment.view, said.words, angle, *numbers))
    return [] if found.why else rows


def _figures(measurements: Sequence[ViewMeasurements]) -> list[tuple[str, ...]]:
    """Head and rows of the table of figures; single shots have fewer of them."""
    shots = any(r.exposures for r in measurements)
    head = ("99 % under", "saturated", "invalid", "dark")
    more = (
        "noise",
        "pair ratio",
        "sum error",
        "DoLP median",
        "DoLP 99 %",
        "polarized",
        "above diffuse limit",
    )
    rows: list[tuple[str, ...]] = [("view", "pictures", *head) if shots else ("view", *head, *more)]
    for r in measurements:
        cells = (f"{r.bright:.3f}", f"{r.saturated:.2%}", f"{r.invalid:.2%}", f"{r.dark:.2%}")
        if shots:
            rows.append((r.view, r.exposures or "0, 45, 90, 135", *cells))
            continue
        ratio = "n/a" if r.pair_ratio is None else f"{r.pair_ratio:.4f}"
        further = (ratio, f"{r.sum_error:.2%}", f"{r.dolp[0]:.3f}", f"{r.dolp[1]:.3f}", f"{r.polarized:.1%}")
        rows.append((r.view, *cells, f"{r.noise_share:.2%}", *further, f"{r.above_limit:.1%}"))
    return rows
