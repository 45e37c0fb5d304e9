"""Corrections of a capture: of its angles, as a new scene; of its sensor's analyzers, in memory."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from polarguide import __version__
from polarguide.capture import checks
from polarguide.capture.calibration import UNIT_GAINS, Calibration, oriented
from polarguide.capture.colmap.files import MODELS
from polarguide.capture.colmap.poses import Geometry, undistortion
from polarguide.capture.formats.pictures import SUFFIXES
from polarguide.capture.layout import describe_contents, index_files
from polarguide.capture.presentation import PRESENTATION_FILE
from polarguide.capture.sensor.analyzers import AnalyzerCalibration, read_analyzers
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.view_reader import read_view
from polarguide.capture.write import intensity_codes, write_view
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file, write_whole, writing
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode, read_record, shortened, to_json
from polarguide.inspection.angles import AngleFindings, swaps
from polarguide.inspection.capture import Capture, InspectedView
from polarguide.inspection.settings import Check

COPIED = ("sparse", "masks", "invalid", "gt", "split.json", PRESENTATION_FILE)
"""Files and folders that are copied unchanged."""
METADATA = "scene.json"


def correction(capture: Capture, angles: AngleFindings) -> Calibration | None:
    """The correction of the angles, or None if they are right.

    Raises:
        PolarguideError: the order is not decided.
    """
    files = angles.files
    if files is None:
        raise PolarguideError(
            capture.root,
            expected="a decided order of the angles",
            found="an order that geometry does not decide",
            remedy="Nothing was written. The report says what to do; --order of prepare sets it by hand.",
        )
    zero = round(angles.offset, 2) if angles.offset is not None else 0.0
    return None if files == ANGLES and zero == 0.0 else Calibration(order=files, zero=zero)


def fix_scene(capture: Capture, change: Calibration, out: Path, reporter: Reporter = SILENT) -> str:
    """Write a corrected copy of a scene; the scene itself does not change.

    If only the order changes, files are copied under their right names, byte by byte. If the zero changes, the four
    intensities are computed anew and written as linear 16-bit PNG; they are divided by 1.21 so that none exceeds full
    scale, and saturated pixels become invalid. The folder appears when it is complete.

    Args:
        capture: the scene. change: from ``correction``. out: a new folder.
        reporter: receives the progress.

    Returns:
        A description of what was done.

    Raises:
        PolarguideError: ``out`` exists, or a file cannot be read or written.
    """
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PolarguideError(
            out,
            expected="a new folder",
            found="a file" if not out.is_dir() else describe_contents(out),
            remedy="Give another --fix; nothing was written.",
        )
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with writing(out):
            _write(capture, change, partial, reporter)
            if out.is_dir():
                out.rmdir()
            os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return described(change)


def described(change: Calibration) -> str:
    """A correction in words."""
    parts = []
    if change.order != ANGLES:
        parts.append(f"the files were renamed ({swaps(change.order)})")
    if change.zero:
        parts.append(f"the Stokes vectors were rotated by {change.zero:+.2f}°")
    return " and ".join(parts)


def _write(capture: Capture, change: Calibration, folder: Path, reporter: Reporter) -> None:
    (folder / "polar").mkdir(parents=True)
    for name in COPIED:
        source = capture.root / name
        _require_inside(capture.root, source)
        if source.is_dir():
            shutil.copytree(source, folder / name)
        elif source.exists():
            shutil.copy2(source, folder / name)
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
    """Refuse links that leave the scene: their targets are not files of the scene, and would be copied.

    Raises:
        PolarguideError: there is one.
    """
    whole = root.resolve()
    for path in (source, *(source.rglob("*") if source.is_dir() else ())):
        leaves = path.exists() and not path.resolve().is_relative_to(whole)
        if leaves or (
            path != source and path.is_symlink() and path.is_dir()
        ):  # such links may lead in a circle
            raise PolarguideError(
                path,
                expected="a file of the scene",
                found=f"a link to {path.resolve()}",
                remedy="Copy into the scene what it points to, or remove it; nothing was written.",
            )


def _rotate_view(capture: Capture, change: Calibration, folder: Path, view: str) -> None:
    data = read_view(capture.layout, view, factor=1, transfer=capture.transfer)
    full = int(np.iinfo(data.peak.dtype).max)
    lost = np.asarray(data.invalid | data.black | (data.peak >= full - full // 500))
    rotated = oriented((data.codes / np.float32(FULL_CODE)).astype(np.float32), change) / change.peak
    old = index_files(folder / "invalid", SUFFIXES).get(view)
    if old is not None:
        old.unlink()
    write_view(folder, view, intensity_codes(rotated, lost), lost)


def _corrected_metadata(capture: Capture, change: Calibration) -> bytes:
    """``scene.json`` of the copy: that of the scene, with a note on the correction."""
    path = capture.root / METADATA
    content: dict[str, Any] = read_record(path, dict[str, Any]) if path.exists() else {}
    note = {
        "program": f"polarguide {__version__}",
        "from": capture.name,
        "digest": capture.digest,
        "change": described(change),
        **change.record(),
        "scale": 1.0 / change.peak,
    }
    before = content.get("corrections", [])
    content["corrections"] = [*(before if isinstance(before, list) else []), note]
    return to_json(content)


STEPS = (1, 2, 4)
"""Pixels of the sensor for each of the picture, that ``prepare`` makes."""
_REMEDY = "Prepare the mosaics with it: polarguide prepare RAW --out SCENE --calibration FILE."


class _Analyzers(msgspec.Struct):
    sensor: str
    lens: str = ""
    sha256: str = ""


class _Warp(msgspec.Struct):
    model: str
    parameters: list[float]


_Gain = Annotated[float, msgspec.Meta(gt=0, le=1e6)]


class _View(msgspec.Struct):
    geometry: Geometry
    warp: _Warp | None = None


class _Settings(msgspec.Struct):
    offset_x: int = 0
    offset_y: int = 0


class _Request(msgspec.Struct):
    settings: _Settings = msgspec.field(default_factory=_Settings)


class _Prepared(msgspec.Struct):
    request: _Request = msgspec.field(default_factory=_Request)
    views: dict[str, _View] = {}


class _Simulated(msgspec.Struct):
    """The sensor of ``synth``, whose mosaics lie beside pictures that it did not take."""

    name: str


class _Scene(msgspec.Struct):
    """The fields of ``scene.json`` that are read."""

    sensor: str | _Simulated | None = None
    gains: tuple[_Gain, _Gain, _Gain, _Gain] | None = None
    analyzers: _Analyzers | None = None
    prepare: _Prepared | None = None


def corrected(capture: Capture, path: Path) -> Capture:
    """The capture as the calibration of its sensor corrects it.

    The matrices follow what ``prepare`` did: its region, the gains that it divided by, the order of the angles, the
    removal of the distortion. Where pictures were averaged, so are the matrices.

    Args:
        capture: of a scene of one sensor's mosaics, or of four pictures a view at its size, half or a quarter of it.
        path: a file of ``polarguide calibrate``.

    Raises:
        PolarguideError: the file cannot be used, is of another sensor or size, or has been applied already.
    """
    calibration = read_analyzers(path)
    about = _about(capture)
    if about.analyzers is not None:
        raise PolarguideError(
            capture.root,
            expected="a scene that was prepared without --calibration",
            found=f"the calibration of {about.analyzers.sensor} (checksum {about.analyzers.sha256[:16]}...)",
            remedy="Leave --calibration out.",
        )
    if isinstance(about.sensor, _Simulated) or (about.prepare is not None and about.sensor is None):
        raise PolarguideError(
            capture.root,
            expected="a scene of the mosaics of a sensor",
            found="a scene of shots through a filter, of a dataset, or rendered",
            remedy="Leave --calibration out.",
        )
    calibration.require_sensor(about.sensor, path)
    applied = capture.applied
    if (applied is None and about.prepare is not None) or (applied is not None and not applied.permutes):
        raise PolarguideError(
            capture.root,
            expected="angles in steps of 45 degrees from those of the sensor",
            found="a scene whose zero was turned",
            remedy=_REMEDY,
        )
    known: dict[Any, NDArray[np.float32]] = {}
    views = []
    for view in capture.views:
        prepared = None if about.prepare is None else about.prepare.views.get(view.name)
        key = None if prepared is None else msgspec.json.encode(prepared)
        if key not in known:
            if prepared is not None:
                _require_geometry(capture, view, prepared)
            matrices = _matrices(calibration, about, prepared, capture.size)
            known[key] = _averaged(_as_named(matrices, applied, about.gains), capture.factor)
            if known[key].shape[2:4] != view.codes.shape[1:3]:
                raise _changed(capture, view.name, "a size that its pictures have not")
        views.append(_corrected_view(view, known[key]))
    return replace(capture, views=tuple(views))


def _changed(capture: Capture, view: str, found: str) -> PolarguideError:
    return PolarguideError(
        f"{capture.root / 'scene.json'} (prepare.views.{view})",
        expected="the record that prepare wrote",
        found=found,
        remedy="Prepare the scene again.",
    )


def _require_geometry(capture: Capture, view: InspectedView, prepared: _View) -> None:
    """Refuse a geometry or a camera that ``prepare`` cannot have written."""
    if prepared.geometry.step not in STEPS:
        raise _changed(capture, view.name, f"a step of {prepared.geometry.step}")
    if prepared.warp is not None:
        model = prepared.warp.model
        parameters = prepared.warp.parameters
        if model not in MODELS or len(parameters) != MODELS[model][1]:
            found = f"a camera {shortened(model)} with {len(parameters)} parameters"
            raise _changed(capture, view.name, found)


def analyzer_check(capture: Capture, path: Path | None) -> Check | None:
    """The calibration of the sensor's analyzers; None where nothing was calibrated."""
    key = "analyzers"
    title = "Analyzers of the sensor"
    if path is not None:
        calibration = read_analyzers(path)
        text = f"Corrected for this inspection with the calibration of {calibration.sensor}"
        remedy = "The scene itself is as it was: prepare its mosaics with --calibration."
        record = calibration.record()
    else:
        analyzers = _about(capture).analyzers
        if analyzers is None:
            return None
        text = f"Prepared with the calibration of {analyzers.sensor}"
        remedy = ""
        record = msgspec.to_builtins(analyzers)
    lens = f" and {record['lens']}" if record["lens"] else ""
    return Check(key, title, "ok", f"{text}{lens} ({record['sha256'][:16]}).", remedy, figures=record)


def _about(capture: Capture) -> _Scene:
    path = capture.root / "scene.json"
    if not path.exists():
        return _Scene()
    return decode(read_file(path), _Scene, path, remedy="Prepare the scene again.")


def _matrices(
    calibration: AnalyzerCalibration, about: _Scene, prepared: _View | None, size: tuple[int, int]
) -> NDArray[np.float32]:
    """Matrices [4, 4, h, w] or [4, 4, h, w, 3] at the pixels of a view's pictures."""
    if prepared is None or about.prepare is None:
        return calibration.of_pictures(size[::-1])
    settings = about.prepare.request.settings
    geometry = prepared.geometry
    matrices = calibration.of_pictures(
        geometry.size[::-1], offset=(settings.offset_x, settings.offset_y), scale=geometry.step
    )
    if prepared.warp is None:
        return matrices
    width, height = geometry.size
    camera = pycolmap.Camera(
        model=prepared.warp.model, width=width, height=height, params=prepared.warp.parameters
    )
    planes = matrices.reshape(16, *matrices.shape[2:])
    moved, _ = undistortion(camera).apply(planes, np.zeros((height, width), bool))
    return moved.reshape(4, 4, *moved.shape[1:])


def _as_named(
    matrices: NDArray[np.float32], applied: Calibration | None, gains: tuple[float, ...] | None
) -> NDArray[np.float32]:
    """Matrices for pictures that were divided by gains, and then named by their true angles."""
    scaled = matrices * np.asarray(gains or UNIT_GAINS, np.float32).reshape(1, 4, *[1] * (matrices.ndim - 2))
    if applied is None:
        return scaled
    source = [int(row.argmax()) for row in oriented(np.eye(4, dtype=np.float32), applied)]
    return scaled[source][:, source]


def _averaged(matrices: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means over boxes of ``factor`` x ``factor`` pixels."""
    if factor == 1:
        return matrices
    height = matrices.shape[2] // factor
    width = matrices.shape[3] // factor
    cut = matrices[:, :, : height * factor, : width * factor]
    boxes = cut.reshape(4, 4, height, factor, width, factor, *matrices.shape[4:])
    return np.asarray(boxes.mean(axis=(3, 5), dtype=np.float32))


def _corrected_view(view: InspectedView, matrices: NDArray[np.float32]) -> InspectedView:
    codes = view.codes.numpy().astype(np.float32)
    weights = matrices if matrices.ndim == 5 else matrices[..., None]
    done = np.stack([sum(weights[k, j] * codes[j] for j in range(4)) for k in range(4)])
    over = (done > FULL_CODE).any(axis=(0, 3))
    saturated = view.saturated | torch.from_numpy(over)
    corrected_codes = np.rint(np.clip(done, 0, FULL_CODE)).astype(np.uint16)
    usable = ~(view.invalid | saturated).numpy()
    return replace(
        view,
        codes=torch.from_numpy(corrected_codes),
        saturated=saturated,
        measures=checks.measure(corrected_codes, usable),
    )
