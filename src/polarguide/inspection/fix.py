"""Write a corrected copy of a scene: pictures named by their true angles, the zero rotated back."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from polarguide import __version__
from polarguide.capture.calibration import Calibration, oriented
from polarguide.capture.layout import describe_contents
from polarguide.capture.view import ANGLES, FULL_CODE
from polarguide.capture.view_reader import read_view
from polarguide.capture.write import intensity_codes, write_view
from polarguide.errors import PolarguideError
from polarguide.files import write_whole, writing
from polarguide.inspection.angle_checks import AngleFindings
from polarguide.inspection.capture import Capture
from polarguide.inspection.orders import FileOrder, swaps
from polarguide.presentation import PRESENTATION_FILE
from polarguide.progress import SILENT, Reporter
from polarguide.records import read_record, to_json

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
                _rename_view(capture, change.order, folder, view)
            advance(done)
    write_whole(folder / METADATA, _corrected_metadata(capture, change))


def _require_inside(root: Path, source: Path) -> None:
    """Refuse links that leave the scene: what they point to is none of its files, and would be copied for others.

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


def _rename_view(capture: Capture, order: FileOrder, folder: Path, view: str) -> None:
    for name, true in zip(ANGLES, order, strict=True):
        source = capture.layout.pictures[view][name]
        shutil.copy2(source, folder / "polar" / f"{view}_{true:03d}{source.suffix}")


def _rotate_view(capture: Capture, change: Calibration, folder: Path, view: str) -> None:
    data = read_view(capture.layout, view, factor=1, transfer=capture.transfer)
    full = int(np.iinfo(data.peak.dtype).max)
    lost = np.asarray(data.invalid | data.black | (data.peak >= full - full // 500))
    rotated = oriented((data.codes / np.float32(FULL_CODE)).astype(np.float32), change) / change.peak
    for old in (folder / "invalid").glob(f"{view}.*"):
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
