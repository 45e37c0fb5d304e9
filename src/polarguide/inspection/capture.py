"""Capture for an inspection. Poses may be missing, for all or some of its views."""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture.calibration import Calibration
from polarguide.capture.colmap.model import ColmapModel, read_model
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.capture.formats.pictures import TRANSFERS, decode_picture, read_picture
from polarguide.capture.layout import CaptureFiles, find_layout, select_views
from polarguide.capture.metadata import (
    Origin,
    applied_calibration,
    indices_of,
    keeps_gains,
    origin_of,
    refractive_index_of,
)
from polarguide.capture.point_exposures import PointExposures
from polarguide.capture.scene import read_views
from polarguide.capture.view import FULL_CODE
from polarguide.capture.view_reader import ViewData
from polarguide.core.files import read_file
from polarguide.core.options import check_choice
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import LARGEST_RECORD
from polarguide.geometry.camera import Camera

LONGEST = 640
"""Largest longer side in pixels after averaging by whole factors."""


@dataclass(frozen=True, eq=False)
class InspectedView:
    """Pictures of a view, usually four, and its pose if it has one.

    Attributes:
        name: name of the view.
        codes: linear intensities as in ``View.codes``, [K, H, W, 3] uint16.
        invalid, saturated: as in ``View``, [H, W] bool.
        black: pixels that are 0 in all angles; they are also ``saturated``.
        camera: camera at the size of ``codes``, or None.
        peak: largest stored value.
        exposures: exposures of the pictures.
    """

    name: str
    codes: Tensor
    invalid: Tensor
    saturated: Tensor
    black: Tensor
    camera: Camera | None
    peak: int
    exposures: tuple[Exposure, ...] = FOUR

    def intensities(self) -> Tensor:
        """Return linear intensities in [0, 1] at the stated angles, [K, H, W, 3] float32."""
        return self.codes.to(torch.float32) / FULL_CODE

    @property
    def usable(self) -> Tensor:
        """Pixels with a measurement, [H, W] bool."""
        return ~(self.invalid | self.saturated)


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture under inspection.

    Attributes:
        root, name: the folder. layout: its files.
        views: all views, sorted by name.
        model: its COLMAP model, or None.
        refractive_index: as ``scene.json`` gives it, or None.
        applied: order, sense and zero that ``prepare`` applied; None for a scene of another origin.
        factor: side of the averaged pixel boxes. transfer: how the files were read.
        bits: bits of the files. size: width and height of the pictures as stored.
        digest: SHA-256 over the stored pictures.
        origin: kind of files that ``prepare`` developed.
        exposures: exposures of the views by shared points, or None.
        keeps_gains: True for scenes of ``prepare --gains none``.
    """

    root: Path
    name: str
    layout: CaptureFiles
    views: tuple[InspectedView, ...]
    model: ColmapModel | None
    refractive_index: float | None
    applied: Calibration | None
    factor: int
    transfer: str
    bits: int
    size: tuple[int, int]
    digest: str
    origin: Origin = "other"
    exposures: PointExposures | None = None
    keeps_gains: bool = False

    @property
    def four(self) -> bool:
        """True if every view has four pictures at 0, 45, 90 and 135 degrees."""
        return all(view.exposures == FOUR for view in self.views)

    @property
    def cameras(self) -> list[tuple[InspectedView, Camera]]:
        """The views with a pose, and their cameras."""
        return [(view, view.camera) for view in self.views if view.camera is not None]

    @property
    def posed(self) -> tuple[InspectedView, ...]:
        """The views with a pose."""
        return tuple(view for view, _ in self.cameras)


def read_capture(
    path: str | os.PathLike[str],
    *,
    downscale: int = 0,
    transfer: str = "linear",
    reporter: Reporter = SILENT,
) -> Capture:
    """Read a scene folder for inspection.

    Args:
        path: a folder in a layout that ``load_scene`` reads; a COLMAP model may be missing.
        downscale: side of the pixel boxes to average; 0: until the longer side is at most 640.
        transfer: "linear" or "srgb".
        reporter: receives the progress.

    Raises:
        PolarguideError: a file cannot be used.
    """
    check_choice("transfer", transfer, TRANSFERS)
    root = Path(path)
    layout = find_layout(root)
    names = select_views(layout, None)
    model = read_model(root) if (root / "sparse").exists() else None
    metadata = root / "scene.json"
    text = read_file(metadata, largest=LARGEST_RECORD) if metadata.exists() else b"{}"
    first = layout.files(names[0])[0]
    factor = downscale or max(
        1, math.ceil(max(decode_picture(first, read_picture(first)).shape[:2]) / LONGEST)
    )
    stored = read_views(layout, names, model, downscale=factor, transfer=transfer, reporter=reporter)
    lines = sorted(f"{p.relative_to(root)} {d}" for item in stored.data for p, d in item.digests.items())
    indices_of(metadata, text)  # raises an error for invalid indices
    return Capture(
        root=root,
        name=root.resolve().name,
        layout=layout,
        views=tuple(
            _inspected_view(item, camera, stored.full_scale)
            for item, camera in zip(stored.data, stored.cameras, strict=True)
        ),
        model=model,
        refractive_index=refractive_index_of(metadata, text),
        applied=applied_calibration(metadata, text),
        factor=factor,
        transfer=transfer,
        bits=8 if stored.largest_value == 255 else 16,
        size=stored.data[0].size,
        digest=hashlib.sha256("\n".join(lines).encode()).hexdigest(),
        origin=origin_of(metadata, text),
        exposures=stored.exposures,
        keeps_gains=keeps_gains(metadata, text),
    )


def _inspected_view(item: ViewData, camera: Camera | None, full_scale: int | None) -> InspectedView:
    return InspectedView(
        name=item.name,
        codes=torch.from_numpy(item.codes),
        invalid=torch.from_numpy(item.invalid),
        saturated=torch.from_numpy(item.saturated(full_scale)),
        black=torch.from_numpy(item.black),
        camera=camera,
        peak=int(item.peak.max()),
        exposures=item.exposures,
    )


MEASURABLE = 1.0 / 256.0
"""Smallest mean intensity of a pixel whose polarization can be measured: a step of 8 bits."""
POLARIZED = 0.05
"""Smallest DoLP of a polarized pixel."""
OF_FOUR = ("noise", "noise_share", "pair_ratio", "sum_error", "dolp", "polarized", "above_limit")
"""Measurements that need four angles of a view."""
_QUANTILE_SAMPLES = 200_000


@dataclass(frozen=True)
class ViewMeasurements:
    """Measurements of one view.

    ``saturated``, ``invalid`` and ``dark`` are shares of all pixels, others of usable pixels.

    Attributes:
        view: its name.
        bright: 99th percentile of the intensities, in [0, 1].
        saturated: share of pixels with an angle at full scale. invalid: share of pixels that the capture marks invalid
            although they are not dark. dark: share of pixels below 1/256.
        noise: median standard deviation of the noise of one intensity (mean over the colors), after averaging.
        noise_share: the same, as a share of S0 / 2.
        pair_ratio: median of (I0 + I90) / (I45 + I135); None if too few pixels are bright enough.
        sum_error: median of |I0 + I90 - I45 - I135| / S0.
        dolp: quantiles 0.5 and 0.99 of the DoLP.
        polarized: share with a DoLP above 0.05 and above three times its noise.
        above_limit: share with a DoLP above the limit of diffuse light by three times its noise.
        exposures: angles of other pictures than 0, 45, 90 and 135 degrees. Values that need four angles are then not
            measured.
    """

    view: str
    bright: float
    saturated: float
    invalid: float
    dark: float
    noise: float = 0.0
    noise_share: float = 0.0
    pair_ratio: float | None = None
    sum_error: float = 0.0
    dolp: tuple[float, float] = (0.0, 0.0)
    polarized: float = 0.0
    above_limit: float = 0.0
    exposures: str = ""

    def record(self) -> dict[str, Any]:
        """Return the measurements as JSON types."""
        measured = {**vars(self), "dolp": {"median": self.dolp[0], "p99": self.dolp[1]}}
        if self.exposures:
            return {key: None if key in OF_FOUR else value for key, value in measured.items()}
        return measured


def measure_view(view: InspectedView, index: float) -> ViewMeasurements:
    """Measure one view.

    Args:
        view: the view.
        index: refractive index.
    """
    gray = view.intensities().mean(dim=-1)
    dark = gray.mean(dim=0) < MEASURABLE
    good = view.usable & ~dark
    share = float(good.float().mean())
    bright = quantile(view.intensities().amax(dim=-1).flatten(), 0.99)
    # Black is not a fault. prepare marks it invalid because it has no information.
    unusable = (view.saturated & ~view.black, view.invalid & ~dark, dark)
    saturated, invalid, black = (float(mask.float().mean()) for mask in unusable)
    measured = ViewMeasurements(view.name, bright, saturated, invalid, black)
    if view.exposures != FOUR:
        return replace(measured, exposures=", ".join(exposure.label for exposure in view.exposures))
    if share < 0.001:
        return measured
    stokes = optics.stokes(gray)
    noise = optics.intensity_noise(gray)
    i0, i45, i90, i135 = (angle[good] for angle in gray)
    s0 = stokes[0][good]
    degree = optics.dolp(stokes)[good]
    spread = optics.dolp_noise(stokes, noise)[good]
    limit = float(optics.diffuse_dolp_limit(index))
    return replace(
        measured,
        noise=quantile(noise[good], 0.5),
        noise_share=quantile(noise[good] / (s0 / 2), 0.5),
        pair_ratio=quantile((i0 + i90) / (i45 + i135).clamp(min=1e-6), 0.5),
        sum_error=quantile((i0 + i90 - i45 - i135).abs() / s0, 0.5),
        dolp=(quantile(degree, 0.5), quantile(degree, 0.99)),
        polarized=float(((degree > POLARIZED) & (degree > 3 * spread)).float().mean()),
        above_limit=float((degree > limit + 3 * spread).float().mean()),
    )


def quantile(values: Tensor, q: float) -> float:
    """Return a quantile of the values, or of a regular subset of many values."""
    step = max(1, values.numel() // _QUANTILE_SAMPLES)
    # NumPy selects and torch sorts, which is much slower.
    return float(np.quantile(values.flatten()[::step].numpy(), q))
