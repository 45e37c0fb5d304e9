"""Write the report of an inspection: an HTML page without scripts or external files, and ``inspection.json``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch.nn.functional import max_pool2d

from polarguide import __version__, optics
from polarguide.core.files import make_folder, write_text, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import to_json
from polarguide.core.text import printable
from polarguide.inspection.capture import InspectedView, ViewMeasurements, quantile
from polarguide.inspection.inspect import Inspection
from polarguide.inspection.settings import json_value
from polarguide.visualization import figures
from polarguide.visualization.figures import AOLP_FULL_DOLP, DOLP_HIGH, Picture
from polarguide.visualization.pages import data_uri, page

SIDE = 240
"""Largest width or height of the pictures on the page, in pixels."""
NOISE_HIGH = 0.05
EXCESS_HIGH = 0.1
SATURATED_COLOR = (255, 40, 40)
INVALID_COLOR = (60, 120, 255)


@dataclass(frozen=True)
class Layer:
    """A kind of picture on the page, such as the DoLP of a view.

    Attributes:
        key: name in HTML.
        label: name on the page.
        legend: description of its colors.
        ramp: color map of the legend's bar, or None.
        caption: function that returns the line below the picture of a view.
    """

    key: str
    label: str
    legend: str
    ramp: str | None
    caption: Callable[[ViewMeasurements], str]


LAYERS: tuple[Layer, ...] = (
    Layer("s0", "S0", "Photograph S0 / 2 in sRGB; the view's 99th percentile is white.", None,
          lambda r: f"99 % under {r.bright:.2f}"),
    Layer("dolp", "DoLP", f"0 to {DOLP_HIGH:g}", "inferno", lambda r: f"median {r.dolp[0]:.3f}, 99 % {r.dolp[1]:.2f}"),
    Layer("aolp", "AoLP", f"Angle of the field by color; dark where the DoLP is below {AOLP_FULL_DOLP:g}.", None,
          lambda r: f"{r.polarized:.0%} polarized"),
    Layer("saturation", "Saturation", "Red: one angle at full scale. Blue: marked invalid, or black.", None,
          lambda r: f"{r.saturated:.1%} + {r.invalid:.1%}"),
    Layer("noise", "Noise", f"Noise of one intensity relative to the photograph: 0 to {NOISE_HIGH:.0%}", "viridis",
          lambda r: f"median {r.noise_share:.2%}"),
    Layer("consistency", "Pair sums", f"|I0 + I90 - I45 - I135| / S0: 0 to {EXCESS_HIGH:.0%}", "magma",
          lambda r: f"median {r.sum_error:.1%}" + ("" if r.pair_ratio is None else f", ratio {r.pair_ratio:.3f}")),
)  # fmt: skip


SHOT_LAYERS: tuple[Layer, ...] = (
    Layer("s0", "Picture", "Mean of the view's pictures in sRGB; its 99th percentile is white.", None,
          lambda r: f"{r.exposures}; 99 % under {r.bright:.2f}"),
    Layer("saturation", "Saturation", "Red: one picture at full scale. Blue: marked invalid, or black.", None,
          lambda r: f"{r.saturated:.1%} + {r.invalid:.1%}"),
)  # fmt: skip
"""Kinds of pictures for captures whose angles are not the usual four."""


def layer_uris(view: InspectedView, layers: Sequence[Layer]) -> dict[str, str]:
    """Draw the pictures of a view for the page. Return them as data URIs by key."""
    photograph = view.intensities().mean(dim=0)
    rgb = figures.radiance_to_rgb(photograph / max(quantile(photograph, 0.99), 1e-6))
    pictures = {"s0": rgb, "saturation": _mark(rgb, view)}
    if layers is LAYERS:
        pictures |= _polarization_layers(view)
    return {layer.key: data_uri(pictures[layer.key], layer.key, SIDE) for layer in layers}


def _polarization_layers(view: InspectedView) -> dict[str, Picture]:
    """Draw the maps that need pictures at four angles."""
    gray = view.intensities().mean(dim=-1)
    stokes = optics.stokes(gray)
    s0 = stokes[0].clamp(min=1e-6)
    degree = optics.dolp(stokes)
    excess = (gray[0] + gray[2] - gray[1] - gray[3]).abs() / s0
    return {
        "dolp": figures.dolp_to_rgb(degree, DOLP_HIGH),
        "aolp": figures.aolp_to_rgb(optics.aolp(stokes), degree / AOLP_FULL_DOLP),
        "noise": figures.scalar_to_rgb(optics.intensity_noise(gray) / (s0 / 2), 0.0, NOISE_HIGH),
        "consistency": figures.scalar_to_rgb(excess, 0.0, EXCESS_HIGH, "magma"),
    }


def _mark(picture: Picture, view: InspectedView) -> Picture:
    """Draw the photograph in dark gray, with saturated and invalid pixels in color."""
    dim = (picture.mean(axis=-1, keepdims=True) * 0.6).astype(np.uint8).repeat(3, axis=-1)
    for mask, color in (
        (view.black | view.invalid, INVALID_COLOR),
        (view.saturated & ~view.black, SATURATED_COLOR),
    ):
        # Dilation keeps single pixels visible after downscaling.
        dim[(max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0).numpy()] = color
    return dim


FILE = "inspection.html"


def inspection_html(inspection: Inspection, reporter: Reporter = SILENT) -> str:
    """Return the HTML page. All names and texts in it are escaped.

    Args:
        inspection: the findings.
        reporter: receiver of the progress.
    """
    capture = inspection.capture
    settings = inspection.settings
    layers = LAYERS if capture.four else SHOT_LAYERS
    marked = {name for check in inspection.checks for name in check.views}
    tiles = []
    with reporter.track("drawing", len(capture.views)) as advance:
        for view, measured in zip(capture.views, inspection.measurements, strict=True):
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
        inspection=inspection,
        layers=layers,
        ramps={layer.ramp: figures.color_gradient(layer.ramp) for layer in layers if layer.ramp},
        wheel=data_uri(figures.angle_wheel(), "aolp", 2 * SIDE),
        tiles=tiles,
        figures=_figures(inspection.measurements),
        facts={
            "transfer": capture.transfer,
            "box filter": f"{capture.factor} x {capture.factor} pixels",
            "refractive index": f"{inspection.index:g}",
            "normals": f"{settings.normals}, {settings.steps} steps if trained",
            "SHA-256 of the pictures": capture.digest,
        },
    )


def _figures(measurements: Sequence[ViewMeasurements]) -> list[tuple[str, ...]]:
    """Return the header and the rows of the table of measurements. Single shots have fewer columns."""
    shots = any(r.exposures for r in measurements)
    columns: dict[str, Callable[[ViewMeasurements], str]] = {
        "view": lambda r: r.view,
        **({"pictures": lambda r: r.exposures or "0, 45, 90, 135"} if shots else {}),
        "99 % under": lambda r: f"{r.bright:.3f}",
        "saturated": lambda r: f"{r.saturated:.2%}",
        "invalid": lambda r: f"{r.invalid:.2%}",
        "dark": lambda r: f"{r.dark:.2%}",
        **({} if shots else _FOUR_COLUMNS),
    }
    return [tuple(columns), *(tuple(text(r) for text in columns.values()) for r in measurements)]


_FOUR_COLUMNS: dict[str, Callable[[ViewMeasurements], str]] = {
    "noise": lambda r: f"{r.noise_share:.2%}",
    "pair ratio": lambda r: "n/a" if r.pair_ratio is None else f"{r.pair_ratio:.4f}",
    "sum error": lambda r: f"{r.sum_error:.2%}",
    "DoLP median": lambda r: f"{r.dolp[0]:.3f}",
    "DoLP 99 %": lambda r: f"{r.dolp[1]:.3f}",
    "polarized": lambda r: f"{r.polarized:.1%}",
    "above diffuse limit": lambda r: f"{r.above_limit:.1%}",
}
"""Functions that format the columns of the table of measurements that need four angles, by column name."""


SCHEMA = 2
"""Version of the record. It increases if a key is removed or changes its meaning, but not for new keys."""
RECORD = "inspection.json"


def inspection_record(inspection: Inspection) -> dict[str, Any]:
    """Return the findings as plain JSON types. docs/reference/inspection.md describes the keys."""
    capture = inspection.capture
    return dict(
        json_value(
            {
                "schema": SCHEMA,
                "program": f"polarguide {__version__}",
                "scene": {
                    "name": capture.name,
                    "path": printable(str(capture.root.resolve())),
                    "views": len(capture.views),
                    "posed_views": len(capture.posed),
                    "size": list(capture.size),
                    "bits": capture.bits,
                    "digest": capture.digest,
                },
                "settings": {
                    "downscale": capture.factor,
                    "transfer": capture.transfer,
                    "refractive_index": inspection.index,
                    "normals": inspection.settings.normals,
                    "steps": inspection.settings.steps,
                },
                "verdict": inspection.verdict,
                "checks": [check.record() for check in inspection.checks],
                "angles": inspection.angles.record(),
                "views": [measured.record() for measured in inspection.measurements],
            }
        )
    )


def write_inspection(inspection: Inspection, out: Path, reporter: Reporter = SILENT) -> tuple[Path, Path]:
    """Write the page and ``inspection.json`` into a folder, and return their two paths.

    Raises:
        PolarguideError: a file cannot be written.
    """
    make_folder(out)
    write_whole(out / RECORD, to_json(inspection_record(inspection)))
    write_text(out / FILE, inspection_html(inspection, reporter))
    return out / FILE, out / RECORD
