"""Read a capture for an inspection. Some or all of its views may have no pose."""

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
from polarguide.capture.formats.pictures import TRANSFERS, decode_picture
from polarguide.capture.formats.stored import read_picture
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
from polarguide.capture.scene import held_out_names, read_views
from polarguide.capture.view import FULL_CODE
from polarguide.capture.view_reader import Files
from polarguide.core.options import check_choice
from polarguide.core.progress import SILENT, Reporter
from polarguide.geometry.camera import Camera

LONGEST = 640
"""Largest width or height of inspected pictures in pixels. Larger pictures are averaged by whole factors."""


@dataclass(frozen=True, eq=False)
class InspectedView:
    """Pictures of one view, usually four, and its pose if it has one.

    Attributes:
        name: name of the view.
        codes: linear intensities as in ``View.codes``, [K, H, W, 3].
        invalid: mask of invalid pixels as in ``View``, [H, W] bool.
        saturated: mask of saturated pixels as in ``View``, [H, W] bool.
        black: mask of pixels that are 0 in all pictures. These pixels are also in ``saturated``.
        camera: camera at the size of ``codes``, or None.
        peak: largest stored value, in units of 16-bit codes for radiance.
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
        """Return linear intensities at the stated angles, [K, H, W, 3] float32.

        They are in [0, 1] unless the pictures are merged exposures.
        """
        return self.codes.to(torch.float32) / FULL_CODE

    @property
    def usable(self) -> Tensor:
        """Mask of pixels with a valid measurement, [H, W] bool."""
        return ~(self.invalid | self.saturated)


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture that is inspected.

    Attributes:
        root: folder of the capture.
        name: name of the folder.
        layout: files of the capture.
        views: all views, sorted by name.
        model: COLMAP model of the capture, or None.
        refractive_index: refractive index that ``scene.json`` states, or None.
        applied: order, direction and zero of the angles that ``prepare`` applied. None for a scene that ``prepare`` did
            not write.
        factor: width of the square pixel blocks that are averaged.
        transfer: transfer function with which the files were read.
        bits: bits of a stored value.
        size: width and height of the pictures as stored.
        digest: SHA-256 of the stored pictures.
        origin: kind of files that ``prepare`` developed.
        exposures: exposures of the views, estimated from points that they share, or None.
        test_names: names of the held-out views.
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
    test_names: tuple[str, ...] = ()

    @property
    def four(self) -> bool:
        """True if every view has four pictures at 0, 45, 90 and 135 degrees."""
        return all(view.exposures == FOUR for view in self.views)

    @property
    def cameras(self) -> list[tuple[InspectedView, Camera]]:
        """Views that have a pose, each with its camera."""
        return [(view, view.camera) for view in self.views if view.camera is not None]

    @property
    def posed(self) -> tuple[InspectedView, ...]:
        """Views that have a pose."""
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
        path: a folder in a layout that ``load_scene`` reads. The COLMAP model may be missing.
        downscale: width of the pixel blocks to average. If 0, it is chosen so that width and height are at most 640.
        transfer: "linear" or "srgb".
        reporter: receiver of the progress.

    Raises:
        PolarguideError: a file cannot be used.
    """
    check_choice("transfer", transfer, TRANSFERS)
    root = Path(path)
    layout = find_layout(root)
    names = select_views(layout, None)
    model = read_model(root) if (root / "sparse").exists() else None
    metadata = root / "scene.json"
    files = Files()
    text = files.read_if_there(metadata, b"{}")
    first = layout.files(names[0])[0]
    factor = downscale or max(
        1,
        math.ceil(max(decode_picture(first, read_picture(first), keep_floats=True).shape[:2]) / LONGEST),
    )
    stored = read_views(layout, names, model, downscale=factor, transfer=transfer, reporter=reporter)
    lines = sorted(f"{p.relative_to(root)} {d}" for item in stored.data for p, d in item.digests.items())
    indices_of(metadata, text)  # raises an error for invalid indices
    return Capture(
        root=root,
        name=root.resolve().name,
        layout=layout,
        views=tuple(
            InspectedView(
                name=item.name,
                codes=torch.from_numpy(item.codes),
                invalid=torch.from_numpy(item.invalid),
                saturated=torch.from_numpy(item.saturated(stored.full_scale)),
                black=torch.from_numpy(item.black),
                camera=camera,
                peak=int(item.peak.max()),
                exposures=item.exposures,
            )
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
        test_names=held_out_names(files, layout, model),
    )


MEASURABLE = 1.0 / 256.0
"""Smallest mean intensity of a pixel whose polarization can be measured. It is one step of an 8-bit value."""
POLARIZED = 0.05
"""Smallest DoLP of a pixel that counts as polarized."""
OF_FOUR = ("noise", "noise_share", "pair_ratio", "sum_error", "dolp", "polarized", "above_limit")
"""Names of the measurements that need pictures at four angles."""
_QUANTILE_SAMPLES = 200_000


@dataclass(frozen=True)
class ViewMeasurements:
    """Measurements of one view.

    ``saturated``, ``invalid`` and ``dark`` are shares of all pixels. All remaining shares refer to usable pixels.

    Attributes:
        view: name of the view.
        bright: 99th percentile of the intensities, in [0, 1].
        saturated: share of pixels that are at full scale in at least one picture.
        invalid: share of pixels that the capture marks as invalid although they are not dark.
        dark: share of pixels whose intensity is below 1/256.
        noise: median standard deviation of the noise of one intensity (mean over the colors), after averaging.
        noise_share: ``noise`` divided by S0 / 2.
        pair_ratio: median of (I0 + I90) / (I45 + I135). None if too few pixels are bright enough.
        sum_error: median of |I0 + I90 - I45 - I135| / S0.
        dolp: median and 99th percentile of the DoLP.
        polarized: share of pixels whose DoLP exceeds 0.05 and three times its noise.
        above_limit: share of pixels whose DoLP exceeds the limit of diffuse light by three times its noise.
        exposures: exposures of the pictures if their angles are not 0, 45, 90 and 135 degrees. Values that need four
            angles are then not measured.
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
    """Measure the brightness, noise and polarization of one view.

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
    """Return a quantile of values. If there are many values, a regular subset is used."""
    step = max(1, values.numel() // _QUANTILE_SAMPLES)
    # NumPy selects and torch sorts, which is much slower.
    return float(np.quantile(values.flatten()[::step].numpy(), q))
