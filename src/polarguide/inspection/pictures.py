"""A capture as the inspection reads it: also one without poses, or with poses for some of its views."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import checks
from polarguide.capture.colmap.model import ColmapModel, fit_camera, read_model
from polarguide.capture.formats.pictures import TRANSFERS, decode_picture, read_file
from polarguide.capture.layout import Layout, find_layout, select_views
from polarguide.capture.metadata import refractive_index_of
from polarguide.capture.view import FULL_CODE
from polarguide.capture.view_reader import ViewData, read_view
from polarguide.errors import PolarguideError
from polarguide.records import parse_json

LONGEST = 640
"""Pixels of the longer side that pictures are averaged down to (by whole factors)."""
_THREADS = 4


@dataclass(frozen=True, eq=False)
class Pictures:
    """The four pictures of a view, and its pose if it has one.

    Attributes:
        name: of the view.
        codes: linear intensities as in ``View.codes``, [4, H, W, 3] uint16.
        invalid, saturated: as in ``View``, [H, W] bool.
        camera: at the size of ``codes``, or None.
        measures: what ``capture.checks`` measures on them.
        peak: largest stored value.
    """

    name: str
    codes: Tensor
    invalid: Tensor
    saturated: Tensor
    camera: Camera | None
    measures: checks.Measures
    peak: int

    def intensities(self) -> Tensor:
        """Linear intensities in [0, 1] at 0, 45, 90, 135 degrees, as the files say: [4, H, W, 3] float32."""
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
        factor: side of the averaged pixel boxes. transfer: how the files were read.
        bits: of the files. size: width and height of the pictures as stored.
        digest: SHA-256 over the stored pictures.
    """

    root: Path
    name: str
    layout: Layout
    views: tuple[Pictures, ...]
    model: ColmapModel | None
    refractive_index: float | None
    factor: int
    transfer: str
    bits: int
    size: tuple[int, int]
    digest: str

    @property
    def posed(self) -> tuple[Pictures, ...]:
        """The views with a pose."""
        return tuple(view for view in self.views if view.camera is not None)


def read_capture(
    path: str | os.PathLike[str],
    *,
    downscale: int = 0,
    transfer: str = "linear",
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Read a scene folder for inspection.

    Args:
        path: a folder in a layout that ``load_scene`` reads; a COLMAP model may be missing.
        downscale: side of the pixel boxes to average; 0: until the longer side is at most 640.
        transfer: "linear" or "srgb".
        progress: called with the number of views read and the number to read.

    Raises:
        PolarguideError: a file cannot be used.
    """
    if transfer not in TRANSFERS:
        raise PolarguideError(
            "transfer", expected="linear or srgb", found=repr(transfer), remedy="Name one of them."
        )
    root = Path(path)
    layout = find_layout(root)
    names = select_views(layout, None)
    model = read_model(root) if (root / "sparse").exists() else None
    sidecar = root / "scene.json"
    index = refractive_index_of(
        sidecar, parse_json(sidecar, read_file(sidecar)) if sidecar.exists() else None
    )
    factor = downscale or _fitting_factor(layout, names[0])
    data: list[ViewData] = []

    def read(name: str) -> ViewData:
        return read_view(layout, name, factor=factor, transfer=transfer)

    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
        for item in pool.map(read, names):
            data.append(item)
            if progress is not None:
                progress(len(data), len(names))
    full = int(np.iinfo(data[0].peak.dtype).max)
    _require_one_depth(data)
    scale = checks.full_scale(np.sum([item.histogram for item in data], axis=0), full)
    lines = sorted(f"{p.relative_to(root)} {digest}" for item in data for p, digest in item.digests.items())
    return Capture(
        root=root,
        name=root.resolve().name,
        layout=layout,
        views=tuple(_pictures(item, model, scale, factor) for item in data),
        model=model,
        refractive_index=index,
        factor=factor,
        transfer=transfer,
        bits=8 if full == 255 else 16,
        size=data[0].size,
        digest=hashlib.sha256("\n".join(lines).encode()).hexdigest(),
    )


def _fitting_factor(layout: Layout, name: str) -> int:
    path = next(iter(layout.pictures[name].values()))
    height, width = decode_picture(path, read_file(path)).shape[:2]
    return max(1, math.ceil(max(height, width) / LONGEST))


def _require_one_depth(data: Sequence[ViewData]) -> None:
    other = [item.name for item in data if item.peak.dtype != data[0].peak.dtype]
    if other:
        raise PolarguideError(
            "pictures",
            expected=f"one number of bits for all views, that of {data[0].name}",
            found=f"another in view {other[0]}",
            remedy="Export all pictures alike.",
        )


def _pictures(item: ViewData, model: ColmapModel | None, scale: int | None, factor: int) -> Pictures:
    camera = None
    if model is not None and item.name in model.names:
        camera = fit_camera(model.camera(item.name), *item.size, folder=model.folder, view=item.name)
        camera = camera.downscaled(factor) if factor > 1 else camera
    saturated = item.saturated(scale)
    return Pictures(
        name=item.name,
        codes=torch.from_numpy(item.codes),
        invalid=torch.from_numpy(item.invalid),
        saturated=torch.from_numpy(saturated),
        camera=camera,
        measures=checks.measure(item.codes, ~(item.invalid | saturated)),
        peak=int(item.peak.max()),
    )
