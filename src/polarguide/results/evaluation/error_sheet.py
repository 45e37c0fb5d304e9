"""``errors.png``: where the errors of the test views are, as heat maps with their scales."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.optics.color import shown
from polarguide.results.evaluation.metrics import Selection, normal_angles_deg
from polarguide.results.evaluation.target import ViewTarget
from polarguide.shading.result import RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, contact_sheet

ERRORS_FILE = "errors.png"
MOST_VIEWS = 8
PICTURE_HIGH = 0.25
NORMAL_HIGH = 45.0
BRIGHTEST = (0.05, 0.5)
"""Between these lies the DoLP from which its pictures are fully bright."""
MAP = "inferno"
NOT_COUNTED = 90
COLUMNS = {
    "photograph": "photograph",
    "final": "picture error",
    "normal": "normal error",
    "specular": "specular error",
    "diffuse": "diffuse error",
    "measured": "AoLP x DoLP",
    "predicted": "predicted",
    "stokes": "S1, S2 error",
}
"""Heading of each column by its key; one that a run has nothing for is left out."""


class ErrorSheet:
    """Pictures of the errors of some views, one row each, and below each column the key to its colors.

    Heat maps are black at no error and bright at the end of their scale; what does not count is gray. Layers and
    picture: mean over channels of the absolute difference of shown values. Polarization: angle of the field as hue,
    degree as brightness, of the channels' mean Stokes vector; its error is the mean over channels of |S1 error| + |S2
    error|. Its scales end at about what a tenth of the pixels measure or more.

    Args:
        views: how many there will be; ``MOST_VIEWS`` of them, evenly chosen, are drawn.
    """

    def __init__(self, views: int) -> None:
        step = max(1, math.ceil(views / MOST_VIEWS))
        self._chosen = range(0, views, step)
        self._added = 0
        self._rows: list[tuple[str, dict[str, Picture]]] = []
        # Measured (None: not known) and predicted Stokes vectors, and where they count: scales depend on all views.
        self._stokes: list[tuple[Tensor | None, Tensor | None, Tensor]] = []

    def add(self, view: View, target: ViewTarget, result: RenderResult, stokes: Tensor | None) -> None:
        """Add the next view, if it is one of those that are drawn; ``stokes`` [3, H, W, 3] as it is predicted."""
        self._added += 1
        if self._added - 1 not in self._chosen:
            return
        pictures = {
            "photograph": figures.radiance_to_rgb(target.photograph),
            "final": _difference(result.final, target.photograph, target.valid),
        }
        for name in ("specular", "diffuse"):
            layer, lobe = getattr(result, name), getattr(target, name)
            if layer is not None and lobe is not None and target.foreground is not None:
                pictures[name] = _difference(layer, lobe / 2, target.foreground)
        if result.normal is not None and target.normal is not None and target.surface is not None:
            angles = normal_angles_deg(result.normal.nan_to_num(), target.normal)
            pictures["normal"] = _heat(angles, target.surface.mask, NORMAL_HIGH)
        keep = target.valid if target.polarized is None else target.polarized
        predicted = None if stokes is None else stokes.cpu().nan_to_num()
        self._rows.append((view.name, pictures))
        measured = view.stokes() if view.is_determined else None
        self._stokes.append((measured, predicted, keep.mask.cpu()))

    def write(self, path: Path) -> None:
        """Write the sheet; nothing where no view was added."""
        if not self._rows:
            return
        ends = {**dict.fromkeys(("final", "specular", "diffuse"), PICTURE_HIGH), "normal": NORMAL_HIGH}
        headings = dict(COLUMNS)
        if any(measured is not None and predicted is not None for measured, predicted, _ in self._stokes):
            brightest, ends["stokes"] = self._draw_polarization()
            headings["measured"] = f"AoLP x DoLP / {brightest:g}"
        keys = [key for key in COLUMNS if any(key in pictures for _, pictures in self._rows)]
        rows: list[list[Picture | None]] = [[pictures.get(key) for key in keys] for _, pictures in self._rows]
        bars = {
            key: figures.scale_bar(0.0, end, MAP, "deg" if key == "normal" else "")
            for key, end in ends.items()
        }
        bars |= dict.fromkeys(("measured", "predicted"), figures.angle_wheel())
        bars["photograph"] = figures.color_patch(NOT_COUNTED, "gray: not counted")
        sheet = contact_sheet(
            rows,
            [name for name, _ in self._rows],
            [headings[key] for key in keys],
            footer=[bars[key] for key in keys],
        )
        figures.write_png(path, sheet)

    def _draw_polarization(self) -> tuple[float, float]:
        """Add the pictures of the polarization; the DoLP that is fully bright, and the end of the errors' scale."""
        counted = [measured[:, keep] for measured, _, keep in self._stokes if measured is not None]
        degrees = torch.cat([optics.dolp(optics.luminance(values)) for values in counted])
        brightest = min(max(_tenth_above(degrees), BRIGHTEST[0]), BRIGHTEST[1])
        high = _tenth_above(torch.cat([_size(values) for values in counted]))
        for (_, pictures), (measured, predicted, keep) in zip(self._rows, self._stokes, strict=True):
            if measured is None:
                continue
            pictures["measured"] = _polarization(measured, brightest)
            if predicted is not None:
                pictures["predicted"] = _polarization(predicted, brightest)
                pictures["stokes"] = _heat(_size(predicted - measured), keep, high)
        return brightest, high


def _difference(pred: Tensor, true: Tensor, keep: Selection) -> Picture:
    error = (shown(pred.nan_to_num(nan=0.0)) - shown(true)).abs().mean(dim=-1)
    return _heat(error, keep.mask, PICTURE_HIGH)


def _heat(values: Tensor, keep: Tensor, high: float) -> Picture:
    picture = figures.scalar_to_rgb(values, 0.0, high, MAP)
    picture[~keep.cpu().numpy()] = NOT_COUNTED
    return picture


def _size(stokes: Tensor) -> Tensor:
    """Mean over channels of |S1| + |S2| of [3, ..., C]."""
    return stokes[1:].abs().sum(dim=0).mean(dim=-1)


def _polarization(stokes: Tensor, brightest: float) -> Picture:
    mean = optics.luminance(stokes)
    return figures.aolp_to_rgb(optics.aolp(mean), (optics.dolp(mean) / brightest).clamp(max=1))


def _tenth_above(values: Tensor) -> float:
    """About what a tenth of the values reach: rounded up to 1, 2 or 5 times a power of ten, at least 0.001."""
    ordered = values.flatten().sort().values
    value = max(float(ordered[int(0.9 * (len(ordered) - 1))]) if len(ordered) else 0.0, 1e-3)
    power = 10.0 ** math.floor(math.log10(value))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * (1 - 1e-9))
