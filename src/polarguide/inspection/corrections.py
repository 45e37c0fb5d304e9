"""Correct a capture. Corrected angles are written as a new scene; a sensor calibration is applied in memory."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from polarguide import __version__
from polarguide.capture import box_filter
from polarguide.capture.angle_evidence import swaps
from polarguide.capture.calibration import UNIT_GAINS, Calibration, oriented
from polarguide.capture.colmap.model import MODELS
from polarguide.capture.colmap.poses import undistortion
from polarguide.capture.formats.pictures import SUFFIXES
from polarguide.capture.layout import describe_contents, index_files
from polarguide.capture.presentation import PRESENTATION_FILE
from polarguide.capture.sensor.analyzers import AnalyzerCalibration, read_analyzers
from polarguide.capture.sensor.pattern import MosaicOptions
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.view_reader import read_view
from polarguide.capture.write import intensity_codes, rounded_radiance, write_view
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file, temporary_folder, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode, read_record, shortened, to_json
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import Capture, InspectedView
from polarguide.inspection.settings import Check
from polarguide.preparation.journal import FourFactors, State, ViewRecord

_COPIED = ("sparse", "masks", "invalid", "gt", "split.json", PRESENTATION_FILE)
"""Names of files and folders that are copied without changes."""
METADATA = "scene.json"


def correction(capture: Capture, angles: AngleFindings) -> Calibration | None:
    """Return the calibration that corrects the angles, or None if the angles are correct.

    Raises:
        PolarguideError: the order is not decided.
    """
    if angles.files is None:
        raise PolarguideError(
            capture.root,
            expected="a decided order of the angles",
            found="an order that geometry does not decide",
            remedy="Nothing was written. Follow the report, or set the order with --order of prepare.",
        )
    change = Calibration(order=angles.files, zero=round(angles.offset or 0.0, 2))
    return None if change == Calibration() else change


def fix_scene(capture: Capture, change: Calibration, out: Path, reporter: Reporter = SILENT) -> str:
    """Write a corrected copy of a scene. The scene itself does not change.

    If only the order changes, files are copied byte by byte under their correct names. If the zero changes, the four
    intensities are recomputed and written as linear 16-bit PNG. They are divided by 1.21 so that no value exceeds full
    scale, and saturated pixels become invalid. The folder appears when it is complete.

    Args:
        capture: the scene.
        change: result of ``correction``.
        out: a new folder.
        reporter: receiver of the progress.

    Returns:
        A description of the correction.

    Raises:
        PolarguideError: ``out`` exists, or a file cannot be read or written.
    """
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PolarguideError(
            out,
            expected="a new folder",
            found="a file" if not out.is_dir() else describe_contents(out),
            remedy="Specify another folder with --fix. Nothing was written.",
        )
    with temporary_folder(out) as partial:
        _write_corrected(capture, change, partial, reporter)
        if out.is_dir():
            out.rmdir()
        os.replace(partial, out)
    return describe_correction(change)


def describe_correction(change: Calibration) -> str:
    """Describe a correction in a sentence for the user."""
    parts = {
        f"the files were renamed ({swaps(change.order)})": change.order != ANGLES,
        f"the Stokes vectors were rotated by {change.zero:+.2f}°": change.zero != 0.0,
    }
    return " and ".join(part for part, changed in parts.items() if changed)


def _write_corrected(capture: Capture, change: Calibration, folder: Path, reporter: Reporter) -> None:
    (folder / "polar").mkdir()
    for name in _COPIED:
        source = capture.root / name
        _require_inside(capture.root, source)
        if source.exists():
            copy = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, folder / name)
    with reporter.track("fixing", len(capture.layout.names)) as advance:
        for done, view in enumerate(capture.layout.names, 1):
            if change.zero:
                _rotate_view(capture, change, folder, view)
            else:
                for named, angle in zip(ANGLES, change.order, strict=True):
                    source = capture.layout.pictures[view][named]
                    shutil.copy2(source, folder / "polar" / f"{view}_{angle:03d}{source.suffix}")
            advance(done)
    write_whole(folder / METADATA, _corrected_metadata(capture, change))


def _require_inside(root: Path, source: Path) -> None:
    """Check that a scene contains no links to files outside of it, because these files would be copied.

    Raises:
        PolarguideError: such a link exists.
    """
    for path in (source, *(source.rglob("*") if source.is_dir() else ())):
        circular = path != source and path.is_symlink() and path.is_dir()
        if circular or (path.exists() and not path.resolve().is_relative_to(root.resolve())):
            raise PolarguideError(
                path,
                expected="a file of the scene",
                found=f"a link to {path.resolve()}",
                remedy="Replace the link by a copy of the file, or remove the link. Nothing was written.",
            )


def _rotate_view(capture: Capture, change: Calibration, folder: Path, view: str) -> None:
    data = read_view(capture.layout, view, factor=1, transfer=capture.transfer)
    full = data.largest_value
    lost = np.asarray(data.invalid | data.saturated(full - full // 500))
    rotated = oriented((data.codes / np.float32(FULL_CODE)).astype(np.float32), change)
    old = index_files(folder / "invalid", SUFFIXES).get(view)
    if old is not None:
        old.unlink()
    if data.is_radiance:
        write_view(folder, view, rounded_radiance(np.maximum(rotated, 0)), lost)
    else:
        write_view(folder, view, intensity_codes(rotated / change.peak, lost), lost)


def _corrected_metadata(capture: Capture, change: Calibration) -> bytes:
    """Return the content of ``scene.json`` for the corrected copy: the original, and a note on the correction."""
    path = capture.root / METADATA
    content: dict[str, Any] = read_record(path, dict[str, Any]) if path.exists() else {}
    note = {
        "program": f"polarguide {__version__}",
        "from": capture.name,
        "digest": capture.digest,
        "change": describe_correction(change),
        **change.record(),
        "scale": 1.0 / change.peak,
    }
    before = content.get("corrections", [])
    content["corrections"] = [*(before if isinstance(before, list) else []), note]
    return to_json(content)


STEPS = (1, 2, 4)
"""Allowed numbers of sensor pixels per pixel of a picture, along each axis, in scenes of ``prepare``."""
_REMEDY = "Prepare the mosaics with it: polarguide prepare RAW --out SCENE --calibration FILE."


class _SceneNotes(msgspec.Struct):
    """Fields of ``scene.json`` that the correction needs. ``sensor`` is an object in scenes of ``synth``."""

    sensor: str | dict[str, Any] | None = None
    gains: FourFactors | None = None
    analyzers: dict[str, str] | None = None
    prepare: State[Any] | None = None


def corrected(capture: Capture, path: Path) -> Capture:
    """Correct the pictures of a capture with the calibration of its sensor.

    The correction matrices undergo the same steps as the pictures in ``prepare``: its region, gains, order of the
    angles, and removal of lens distortion. They are then averaged like the pictures.

    Args:
        capture: a scene with mosaics of one sensor, or with four pictures per view at the full, half or quarter size of
            the sensor.
        path: a file of ``polarguide calibrate``.

    Raises:
        PolarguideError: the file is invalid, belongs to another sensor or size, or has been applied already.
    """
    calibration = read_analyzers(path)
    notes = _notes(capture)
    if notes.analyzers is not None:
        raise PolarguideError(
            capture.root,
            expected="a scene that was prepared without --calibration",
            found=_calibration_name(notes.analyzers),
            remedy="Omit --calibration.",
        )
    if isinstance(notes.sensor, dict) or (notes.prepare is not None and notes.sensor is None):
        raise PolarguideError(
            capture.root,
            expected="a scene of the mosaics of a sensor",
            found="a scene of shots through a filter, of a dataset, or rendered",
            remedy="Omit --calibration.",
        )
    calibration.require_sensor(notes.sensor, path)
    applied = capture.applied
    rotated = notes.prepare is not None if applied is None else not applied.permutes
    if rotated:
        raise PolarguideError(
            capture.root,
            expected="a scene whose angles differ from those of its sensor by multiples of 45 degrees",
            found="a scene with another zero of its angles",
            remedy=_REMEDY,
        )
    cache: dict[bytes, NDArray[np.float32]] = {}
    views = []
    for view in capture.views:
        prepared = None if notes.prepare is None else notes.prepare.views.get(view.name)
        key = b"" if prepared is None else msgspec.json.encode((prepared.geometry, prepared.warp))
        if key not in cache:
            matrices = _by_true_angle(
                _matrices(calibration, notes, prepared, capture, view.name), applied, notes.gains
            )
            boxes = box_filter.mean(np.moveaxis(matrices, (2, 3), (0, 1)), capture.factor)
            cache[key] = np.moveaxis(boxes, (0, 1), (2, 3))
            if cache[key].shape[2:4] != view.codes.shape[1:3]:
                raise _record_fault(capture, view.name, "a size that differs from its pictures")
        views.append(_corrected_view(view, cache[key]))
    return replace(capture, views=tuple(views))


def _record_fault(capture: Capture, view: str, found: str) -> PolarguideError:
    return PolarguideError(
        f"{capture.root / METADATA} (prepare.views.{view})",
        expected="the record that prepare wrote",
        found=found,
        remedy="Prepare the scene again.",
    )


def _calibration_name(record: Mapping[str, str]) -> str:
    """Return the name of a calibration, for messages. ``record`` is its record in ``scene.json``."""
    lens = f" and {record['lens']}" if record.get("lens") else ""
    return f"the calibration of {record.get('sensor', '')}{lens} ({record.get('sha256', '')[:16]})"


def analyzer_check(capture: Capture, path: Path | None) -> Check | None:
    """Report the calibration of the sensor that was applied. Return None if there is no calibration."""
    if path is not None:
        record = read_analyzers(path).record()
        finding = f"Corrected for this inspection with {_calibration_name(record)}."
        remedy = "The scene itself is unchanged: prepare its mosaics with --calibration."
        return Check("analyzers", "ok", finding, remedy, figures=record)
    analyzers = _notes(capture).analyzers
    if analyzers is None:
        return None
    finding = f"Prepared with {_calibration_name(analyzers)}."
    return Check("analyzers", "ok", finding, figures=analyzers)


def _notes(capture: Capture) -> _SceneNotes:
    path = capture.root / METADATA
    data = read_file(path) if path.exists() else b"{}"
    return decode(data, _SceneNotes, path, remedy="Prepare the scene again.")


def _matrices(
    calibration: AnalyzerCalibration,
    notes: _SceneNotes,
    prepared: ViewRecord | None,
    capture: Capture,
    view: str,
) -> NDArray[np.float32]:
    """Return correction matrices for the pixels of a view, [4, 4, h, w] or [4, 4, h, w, 3].

    Raises:
        PolarguideError: the geometry or the camera in the scene does not fit a scene of ``prepare``.
    """
    if prepared is None or notes.prepare is None:
        return calibration.of_pictures(capture.size[::-1])
    options = decode(notes.prepare.request.settings, MosaicOptions, capture.root / METADATA)
    geometry = prepared.geometry
    if geometry.step not in STEPS:
        raise _record_fault(capture, view, f"a step of {geometry.step}")
    matrices = calibration.of_pictures(
        geometry.size[::-1], offset=(options.offset_x, options.offset_y), scale=geometry.step
    )
    if prepared.warp is None:
        return matrices
    model = prepared.warp.model
    parameters = prepared.warp.parameters
    if model not in MODELS or len(parameters) != MODELS[model][1]:
        raise _record_fault(capture, view, f"a camera {shortened(model)} with {len(parameters)} parameters")
    width, height = geometry.size
    camera = pycolmap.Camera(model=model, width=width, height=height, params=parameters)
    planes = matrices.reshape(16, *matrices.shape[2:])
    moved, _ = undistortion(camera).apply(planes, np.zeros((height, width), bool))
    return moved.reshape(4, 4, *moved.shape[1:])


def _by_true_angle(
    matrices: NDArray[np.float32], applied: Calibration | None, gains: tuple[float, ...] | None
) -> NDArray[np.float32]:
    """Return correction matrices for pictures that were divided by gains and then named by their true angles."""
    scaled = matrices * np.asarray(gains or UNIT_GAINS, np.float32).reshape(1, 4, *[1] * (matrices.ndim - 2))
    if applied is None:
        return scaled
    source = [int(row.argmax()) for row in oriented(np.eye(4, dtype=np.float32), applied)]
    return scaled[source][:, source]


def _corrected_view(view: InspectedView, matrices: NDArray[np.float32]) -> InspectedView:
    stored = view.codes.numpy().astype(np.float32)
    weights = matrices if matrices.ndim == 5 else matrices[..., None]
    values = np.stack([sum(weights[k, j] * stored[j] for j in range(4)) for k in range(4)])
    if view.codes.dtype == torch.float32:
        return replace(view, codes=torch.from_numpy(np.maximum(values, 0)))
    saturated = view.saturated | torch.from_numpy((values > FULL_CODE).any(axis=(0, 3)))
    codes = np.rint(np.clip(values, 0, FULL_CODE)).astype(np.uint16)
    return replace(view, codes=torch.from_numpy(codes), saturated=saturated)
