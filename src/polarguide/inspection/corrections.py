"""Correct the angles of a capture, and report the calibration of its sensor."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polarguide import __version__
from polarguide.capture.angle_evidence import swaps
from polarguide.capture.calibration import Calibration, oriented
from polarguide.capture.formats.pictures import SUFFIXES
from polarguide.capture.layout import describe_contents, index_files
from polarguide.capture.presentation import PRESENTATION_FILE
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.view_reader import read_view
from polarguide.capture.write import intensity_codes, rounded_radiance, write_view
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file, temporary_folder, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode, read_record, to_json
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import Capture
from polarguide.inspection.settings import Check

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


class _SceneNotes(msgspec.Struct):
    """Fields of ``scene.json`` that the inspection reports."""

    analyzers: dict[str, str] | None = None


def analyzer_check(capture: Capture) -> Check | None:
    """Report the calibration of the sensor that ``prepare`` applied. Return None if there is no calibration."""
    path = capture.root / METADATA
    data = read_file(path) if path.exists() else b"{}"
    analyzers = decode(data, _SceneNotes, path, remedy="Prepare the scene again.").analyzers
    if analyzers is None:
        return None
    lens = f" and {analyzers['lens']}" if analyzers.get("lens") else ""
    name = f"the calibration of {analyzers.get('sensor', '')}{lens} ({analyzers.get('sha256', '')[:16]})"
    return Check("analyzers", "ok", f"Prepared with {name}.", figures=analyzers)
