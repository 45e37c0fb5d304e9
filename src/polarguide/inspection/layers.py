"""Layers of a view (S0, DoLP, AoLP, ...) for the inspection page, as data URIs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from polarguide import optics
from polarguide.inspection.capture import InspectedView, ViewMeasurements, quantile
from polarguide.visualization import figures
from polarguide.visualization.embedded import data_uri
from polarguide.visualization.figures import Picture
from polarguide.visualization.layers import AOLP_FULL_DOLP, DOLP_HIGH

SIDE = 240
"""Longest side of the pictures in pixels."""
NOISE_HIGH, EXCESS_HIGH = 0.05, 0.1
SATURATED_COLOR, INVALID_COLOR = (255, 40, 40), (60, 120, 255)


@dataclass(frozen=True)
class Layer:
    """A layer that the page can show.

    Attributes:
        key, label: its name in HTML and for people. legend: a description of its colors.
        ramp: color map of the legend's bar, or None. caption: the line below a view.
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
    Layer("noise", "Noise", f"Of one intensity relative to the photograph: 0 to {NOISE_HIGH:.0%}", "viridis",
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
"""Of captures with other pictures than four angles a view."""


def layer_uris(view: InspectedView, layers: Sequence[Layer]) -> dict[str, str]:
    """Layers of a view as data URIs, by key."""
    return {layer.key: data_uri(picture, layer.key, SIDE) for layer, picture in _drawn(view, layers)}


def _drawn(view: InspectedView, layers: Sequence[Layer]) -> Iterator[tuple[Layer, Picture]]:
    pictures = _shot_pictures(view) if layers is SHOT_LAYERS else _pictures(view)
    return ((layer, pictures[layer.key]) for layer in layers)


def _shot_pictures(view: InspectedView) -> dict[str, Picture]:
    shown = _shown(view.intensities().mean(dim=0))
    return {"s0": shown, "saturation": _marked(shown, view)}


def _shown(photograph: Tensor) -> Picture:
    return figures.radiance_to_rgb(photograph / max(quantile(photograph, 0.99), 1e-6))


def _pictures(view: InspectedView) -> dict[str, Picture]:
    intensities = view.intensities()
    gray = intensities.mean(dim=-1)
    stokes = optics.stokes(gray)
    s0, degree = stokes[0].clamp(min=1e-6), optics.dolp(stokes)
    shown = _shown(intensities.mean(dim=0))
    excess = (gray[0] + gray[2] - gray[1] - gray[3]).abs() / s0
    return {
        "s0": shown,
        "dolp": figures.dolp_to_rgb(degree, DOLP_HIGH),
        "aolp": figures.aolp_to_rgb(optics.aolp(stokes), degree / AOLP_FULL_DOLP),
        "saturation": _marked(shown, view),
        "noise": figures.scalar_to_rgb(optics.intensity_noise(gray) / (s0 / 2), 0.0, NOISE_HIGH),
        "consistency": figures.scalar_to_rgb(excess, 0.0, EXCESS_HIGH, "magma"),
    }


def _marked(shown: Picture, view: InspectedView) -> Picture:
    """The photograph in dark gray, with saturated and invalid pixels in color."""
    dim = (shown.mean(axis=-1, keepdims=True) * 0.6).astype(np.uint8).repeat(3, axis=-1)
    for mask, color in (
        (view.black | view.invalid, INVALID_COLOR),
        (view.saturated & ~view.black, SATURATED_COLOR),
    ):
        dim[_dilated(mask).numpy()] = color
    return dim


def _dilated(mask: Tensor) -> Tensor:
    """A mask [H, W] dilated by a pixel, so that single pixels stay visible after downscaling."""
    return torch.nn.functional.max_pool2d(mask[None, None].float(), 3, 1, 1)[0, 0] > 0
