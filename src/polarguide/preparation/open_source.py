"""Detect the format of a folder, and the origin of its poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from polarguide.capture.colmap.poses import Poses
from polarguide.capture.datasets import PISR_SENSOR, detect_dataset, open_dataset
from polarguide.capture.filter import find_shots
from polarguide.capture.layout import angle_folders, describe_contents
from polarguide.errors import PolarguideError
from polarguide.preparation.filter_source import FilterSource
from polarguide.preparation.mosaic_source import MosaicSource
from polarguide.preparation.object_masks import MaskedSource
from polarguide.preparation.settings import PrepareSettings, check_format
from polarguide.preparation.source import Source
from polarguide.preparation.stokes_source import StokesSource


def open_source(root: Path, settings: PrepareSettings) -> Source:
    """Open the pictures in a folder, in the given or detected format.

    Raises:
        PolarguideError: there is no such folder, or nothing in it that can be read.
    """
    if not root.is_dir():
        raise PolarguideError(
            root,
            expected="a folder of camera files",
            found="a file" if root.exists() else "nothing",
            remedy="Give the folder that holds the raw mosaics, or the shots through the filter.",
        )
    kind: str = settings.format
    if kind == "auto":
        kind = detect_dataset(root) or "filter"
        if kind == "filter" and not angle_folders(root):
            several = any(len(files) > 1 for files in find_shots(root).values())
            kind = "filter" if several else "mosaic"
    check_format(settings, kind)
    found = _source(root, settings, kind)
    if not found.views:
        raise PolarguideError(
            root,
            expected="raw mosaics (PNG, TIFF, .npy, .raw) or four shots per view (folders 0, 45, 90, 135)"
            if kind in ("mosaic", "filter")
            else f"the files of a {kind} dataset",
            found=describe_contents(root),
            remedy="See docs/reference/formats.md for the layouts.",
        )
    return found if settings.masks is None else MaskedSource(found, settings.masks)


def _source(root: Path, settings: PrepareSettings, kind: str) -> Source:
    if kind == "filter":
        return FilterSource(root, settings)
    if kind == "mosaic":
        return MosaicSource(root, settings)
    dataset = open_dataset(root, kind, transfer=settings.transfer)
    if dataset.mosaics is None:
        return StokesSource(dataset, settings)
    calibration = replace(settings.calibration, sense=settings.calibration.sense or dataset.sense)
    settings = replace(settings, sensor=settings.sensor or PISR_SENSOR, calibration=calibration)
    return MosaicSource(dataset.mosaics, settings, dataset)


def origin_of_poses(pictures: Source, asked: str) -> str:
    """The origin of the poses: "dataset", "sfm", "none" or a path."""
    if asked == "auto":
        return "sfm" if pictures.cameras is None else "dataset"
    if asked == "dataset" and pictures.cameras is None:
        raise PolarguideError(
            "--poses",
            expected=f"sfm, none or the path of a COLMAP model for the format {pictures.kind}",
            found="dataset",
            remedy="Only published datasets contain poses.",
        )
    return asked


def known_poses(root: Path, pictures: Source, origin: str) -> Poses | None:
    """The poses of a dataset or COLMAP model; None for other origins."""
    if origin in ("sfm", "none"):
        return None
    if origin == "dataset":
        assert pictures.cameras is not None
        return Poses.of_cameras(pictures.cameras, root, pictures.views)
    return Poses.read(Path(origin), pictures.views)
