"""--fix: pictures under their true names, zeros turned back, sources untouched, nothing half-written."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import soft_intensities, write_scene
from faults import Fault

from polarguide.capture.angle_evidence import ORDERS, PAIRINGS, OrderPosterior
from polarguide.capture.calibration import Calibration, oriented
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection import corrections as fixing
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import read_capture


def decided(
    order: int, offset: float = 0.0, error: float = 0.1, p: float = 0.99, pairing: int = 0
) -> AngleFindings:
    rest = (1 - p) / 7
    probabilities = tuple(p if k == order else rest for k in range(8))
    return AngleFindings(pairing, (), OrderPosterior((0.0,) * 8, probabilities, offset, error))


def hashes(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize(("order", "pairing"), [*((k, 0) for k in range(1, 8)), (3, 1), (6, 2)])
def test_misnamed_files_get_their_names_back_byte_by_byte(tmp_path, order: int, pairing: int) -> None:
    right = write_scene(tmp_path / "right")
    files = ORDERS[order].files(PAIRINGS[pairing])
    places = [ANGLES.index(angle) for angle in files]
    root = write_scene(tmp_path / "wrong", lambda values: values[places])
    (root / "split.json").write_text('{"test": ["v0"]}')
    (root / "masks").mkdir()
    (root / "masks" / "v0.png").write_bytes((root / "polar" / "v0_000.png").read_bytes())
    before = hashes(root)
    change = fixing.correction(read_capture(root), decided(order, pairing=pairing))
    assert change == Calibration(order=files)
    said = fixing.fix_scene(read_capture(root), change, tmp_path / "fixed")
    assert "was taken at" in said
    fixed = hashes(tmp_path / "fixed")
    assert {k: v for k, v in fixed.items() if k.startswith("polar")} == hashes(right)
    assert fixed["split.json"] == before["split.json"]
    assert fixed["masks/v0.png"] == before["masks/v0.png"]
    assert hashes(root) == before
    note = json.loads((tmp_path / "fixed" / "scene.json").read_text())["corrections"][0]
    assert note["order"] == list(files)
    assert note["change"] == said


def test_a_zero_is_turned_back_and_saturated_pixels_become_invalid(tmp_path) -> None:
    def turned(values: np.ndarray) -> np.ndarray:
        values = oriented(values.astype(np.float32), Calibration(zero=-10.0))
        values[0, 5, 7] = 1.0
        return values

    root = write_scene(tmp_path / "turned", turned)
    (root / "scene.json").write_text('{"refractive_index": 1.4, "corrections": [{"change": "earlier"}]}')
    change = fixing.correction(read_capture(root), decided(0, offset=10.0))
    assert change is not None
    assert change.zero == 10.0
    fixing.fix_scene(read_capture(root), change, tmp_path / "fixed")
    found = read_capture(tmp_path / "fixed")
    assert found.refractive_index == 1.4
    view = found.views[1]
    assert view.invalid[5, 7]
    assert view.invalid.sum() == 1
    expected = soft_intensities(1) / change.peak
    off = np.abs(view.intensities().numpy() - expected)[:, ~view.invalid.numpy()]
    assert off.max() < 1e-3
    corrections = json.loads((tmp_path / "fixed" / "scene.json").read_text())["corrections"]
    assert corrections[0] == {"change": "earlier"}
    assert corrections[1]["scale"] == pytest.approx(1 / change.peak)


def test_what_is_right_is_left_alone(tmp_path) -> None:
    capture = read_capture(write_scene(tmp_path / "s"))
    assert fixing.correction(capture, decided(0)) is None
    assert fixing.correction(capture, decided(0, offset=2.0)) is None
    assert fixing.correction(capture, decided(0, offset=8.0, error=4.0)) is None


@pytest.mark.parametrize("angles", [decided(2, p=0.9), AngleFindings(0, (), None)])
def test_what_is_not_decided_is_refused(tmp_path, angles: AngleFindings) -> None:
    capture = read_capture(write_scene(tmp_path / "s"))
    Fault(expected="a decided order of the angles").raised_by(fixing.correction, capture, angles)


def test_a_folder_with_something_in_it_is_refused(tmp_path) -> None:
    capture = read_capture(write_scene(tmp_path / "s"))
    before = hashes(tmp_path)
    Fault(expected="a new folder").raised_by(
        fixing.fix_scene, capture, Calibration(order=(90, 45, 0, 135)), tmp_path / "s"
    )
    assert hashes(tmp_path) == before


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch) -> None:
    capture = read_capture(write_scene(tmp_path / "s"))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fixing, "write_whole", full)
    Fault(found="No space left").raised_by(
        fixing.fix_scene, capture, Calibration(order=(90, 45, 0, 135)), tmp_path / "fixed"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]


@pytest.mark.parametrize("name", ["gt", "masks/v0.png", "split.json"])
def test_no_link_that_leaves_the_scene_is_copied(tmp_path, name: str) -> None:
    """A scene from somebody else, whose copy is handed on: what a link points to is none of its files."""
    root = write_scene(tmp_path / "wrong")
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "key").write_text("mine")
    (root / name).parent.mkdir(exist_ok=True)
    (root / name).symlink_to(secret if name == "gt" else secret / "key")
    capture = replace(read_capture(write_scene(tmp_path / "right")), root=root)
    change = Calibration(order=ORDERS[3].files(PAIRINGS[0]))
    Fault(found="a link to", remedy="Nothing was written").raised_by(
        fixing.fix_scene, capture, change, tmp_path / "fixed"
    )
    assert not (tmp_path / "fixed").exists()


def test_a_link_within_the_scene_is_copied(tmp_path) -> None:
    root = write_scene(tmp_path / "scene")
    (root / "masks").mkdir()
    (root / "masks" / "v0.png").symlink_to(root / "polar" / "v0_000.png")
    fixing.fix_scene(read_capture(root), Calibration(order=ORDERS[3].files(PAIRINGS[0])), tmp_path / "fixed")
    copy = tmp_path / "fixed" / "masks" / "v0.png"
    assert not copy.is_symlink()
    assert copy.read_bytes() == (root / "polar" / "v0_000.png").read_bytes()


def test_links_that_lead_in_a_circle_are_refused(tmp_path) -> None:
    root = write_scene(tmp_path / "scene")
    (root / "masks").mkdir()
    for name in "ab":  # followed, they would be copied without end
        (root / "masks" / name).symlink_to("../masks")
    change = Calibration(order=(90, 45, 0, 135))
    Fault("masks/b", expected="a file of the scene").raised_by(
        fixing.fix_scene, read_capture(root), change, tmp_path / "fixed"
    )
    assert not (tmp_path / "fixed").exists()


def test_corrections_that_are_none(tmp_path) -> None:
    root = write_scene(tmp_path / "scene")
    (root / "scene.json").write_text('{"corrections": 5}')
    fixing.fix_scene(read_capture(root), Calibration(order=(90, 45, 0, 135)), tmp_path / "fixed")
    assert len(json.loads((tmp_path / "fixed" / "scene.json").read_text())["corrections"]) == 1
