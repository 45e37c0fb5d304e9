"""Read a capture for inspection; it may have no poses, or poses for some of its views only."""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import checks
from polarguide.capture.calibration import Calibration
from polarguide.capture.colmap.model import ColmapModel, read_model
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.capture.formats.pictures import decode_picture, read_picture
from polarguide.capture.layout import Layout, find_layout, select_views
from polarguide.capture.metadata import applied_calibration, indices_of, refractive_index_of
from polarguide.capture.reader import StoredViews, check_transfer, read_views
from polarguide.capture.view import FULL_CODE
from polarguide.files import read_file
from polarguide.progress import SILENT, Reporter
from polarguide.records import LARGEST_RECORD

LONGEST = 640
"""Pixels of the longer side that pictures are averaged down to (by whole factors)."""


@dataclass(frozen=True, eq=False)
class InspectedView:
    """The pictures of a view, four mostly, and its pose if it has one.

    Attributes:
        name: of the view.
        codes: linear intensities as in ``View.codes``, [K, H, W, 3] uint16.
        invalid, saturated: as in ``View``, [H, W] bool.
        black: pixels that are 0 in all angles; they count as ``saturated``, too.
        camera: at the size of ``codes``, or None.
        measures: what ``capture.checks`` measures on them.
        peak: largest stored value.
        exposures: what the pictures are.
    """

    name: str
    codes: Tensor
    invalid: Tensor
    saturated: Tensor
    black: Tensor
    camera: Camera | None
    measures: checks.Measures
    peak: int
    exposures: tuple[Exposure, ...] = FOUR

    def intensities(self) -> Tensor:
        """Linear intensities in [0, 1], at 0, 45, 90, 135 degrees mostly, as the files say: [K, H, W, 3] float32."""
        return self.codes.to(torch.float32) / FULL_CODE

    @property
    def usable(self) -> Tensor:
        """Pixels that carry a measurement, [H, W] bool."""
        return ~(self.invalid | self.saturated)


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture under inspection.

    Attributes:
        root, name: the folder. layout: its files.
        views: all views, sorted by name.
        model: its COLMAP model, or None.
        refractive_index: as ``scene.json`` gives it, or None.
        applied: order, sense and zero that ``prepare`` made the pictures with; None for a scene of another origin.
        factor: side of the averaged pixel boxes. transfer: how the files were read.
        bits: of the files. size: width and height of the pictures as stored.
        digest: SHA-256 over the stored pictures.
    """

    root: Path
    name: str
    layout: Layout
    views: tuple[InspectedView, ...]
    model: ColmapModel | None
    refractive_index: float | None
    applied: Calibration | None
    factor: int
    transfer: str
    bits: int
    size: tuple[int, int]
    digest: str

    @property
    def four(self) -> bool:
        """Whether every view has its four pictures at 0, 45, 90 and 135 degrees."""
        return all(view.exposures == FOUR for view in self.views)

    @property
    def posed(self) -> tuple[InspectedView, ...]:
        """The views with a pose."""
        return tuple(view for view in self.views if view.camera is not None)


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
    check_transfer(transfer)
    root = Path(path)
    layout = find_layout(root)
    names = select_views(layout, None)
    model = read_model(root) if (root / "sparse").exists() else None
    metadata = root / "scene.json"
    said = read_file(metadata, largest=LARGEST_RECORD) if metadata.exists() else None
    factor = downscale or _fitting_factor(layout, names[0])
    stored = read_views(layout, names, model, downscale=factor, transfer=transfer, reporter=reporter)
    lines = sorted(f"{p.relative_to(root)} {d}" for item in stored.data for p, d in item.digests.items())
    indices_of(metadata, said)  # that it can be read
    return Capture(
        root=root,
        name=root.resolve().name,
        layout=layout,
        views=tuple(_inspected(stored, number) for number in range(len(names))),
        model=model,
        refractive_index=refractive_index_of(metadata, said),
        applied=applied_calibration(metadata, said),
        factor=factor,
        transfer=transfer,
        bits=8 if stored.largest_value == 255 else 16,
        size=stored.data[0].size,
        digest=hashlib.sha256("\n".join(lines).encode()).hexdigest(),
    )


def _fitting_factor(layout: Layout, name: str) -> int:
    path = layout.files(name)[0]
    height, width = decode_picture(path, read_picture(path)).shape[:2]
    return max(1, math.ceil(max(height, width) / LONGEST))


def _inspected(stored: StoredViews, number: int) -> InspectedView:
    item = stored.data[number]
    return InspectedView(
        name=item.name,
        codes=torch.from_numpy(item.codes),
        invalid=torch.from_numpy(item.invalid),
        saturated=torch.from_numpy(item.saturated(stored.full_scale)),
        black=torch.from_numpy(item.black),
        camera=stored.cameras[number],
        measures=stored.measures[number],
        peak=int(item.peak.max()),
        exposures=item.exposures,
    )
