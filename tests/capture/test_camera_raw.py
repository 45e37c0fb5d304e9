"""Camera raw: linear, alike for all four shots, and with one clear line when it cannot be read."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_files import ANGLES, behind, read_invalid, read_polar, smooth_light

from polarguide.capture.filter.camera_raw import read_camera_raw
from polarguide.capture.filter.exif import apply_orientation
from polarguide.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

PLAIN = PrepareSettings(poses="none", gains="none", align=False)
UNIT = (1.0, 1.0, 1.0)


def write_shots(folder: Path, light: np.ndarray, *, orientation: int = 1) -> None:
    pytest.importorskip("rawpy")
    pytest.importorskip("tifffile")
    from raw_photographs import write_dng

    for angle, values in zip(ANGLES, behind(light), strict=True):
        write_dng(folder / str(angle) / "cup.dng", values, orientation=orientation)


def test_raw_shots_come_out_linear_on_one_scale(tmp_path: Path) -> None:
    light = smooth_light(64, 96)
    write_shots(tmp_path / "in", light)
    done = prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    assert done.views == ["cup"]
    error = np.abs(read_polar(tmp_path / "out", "cup") - behind(light))[:, 2:-2, 2:-2]
    assert error.max() < 2e-3  # 12 bits and bilinear demosaicing of smooth light
    found = json.loads((tmp_path / "out" / "scene.json").read_text())
    assert found["transfer"] == "linear"
    assert any("camera raw" in note for note in found["notes"])


def test_dark_shots_are_not_brightened(tmp_path: Path) -> None:
    """LibRaw would take the brightest pixel of a shot for white; the ratios of the shots are what is measured."""
    light = smooth_light(64, 96)
    light[1:] = 0
    write_shots(tmp_path / "in", light * np.array([0.9, 1, 1])[:, None, None, None])
    write_shots(tmp_path / "dark", light * 0.2)
    for name in ("in", "dark"):
        prepare_scene(tmp_path / name, tmp_path / f"{name} out", PLAIN)
    bright, dark = (read_polar(tmp_path / f"{name} out", "cup").mean() for name in ("in", "dark"))
    assert dark / bright == pytest.approx(0.2 / 0.9, rel=0.01)


def test_white_balance_and_saturation(tmp_path: Path) -> None:
    light = smooth_light(64, 96)
    light[:, 20:26, 30:36] *= 3
    write_shots(tmp_path / "in", light)
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, white_balance="1,1.25,1.6"))
    polar, invalid = read_polar(tmp_path / "out", "cup"), read_invalid(tmp_path / "out", "cup")
    assert invalid[21:25, 31:35].all()
    expected = behind(light) * [1, 1.25, 1.6]
    inside = ~invalid
    inside[:2] = inside[-2:] = inside[:, :2] = inside[:, -2:] = inside[18:28, 28:38] = False
    np.testing.assert_allclose(polar[:, inside], expected[:, inside], atol=4e-3)


def test_orientation_turns_pixels_and_angles(tmp_path: Path) -> None:
    stored = smooth_light(64, 96)
    write_shots(tmp_path / "in", stored, orientation=6)
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    upright = np.stack([apply_orientation(plane, 6) for plane in stored])
    upright[1:] *= -1
    error = np.abs(read_polar(tmp_path / "out", "cup") - behind(upright))[:, 2:-2, 2:-2]
    assert error.max() < 2e-3


def test_raw_is_not_srgb(tmp_path: Path) -> None:
    write_shots(tmp_path / "in", smooth_light(64, 96))
    with pytest.raises(PolarguideError, match="--transfer: expected auto or linear"):
        prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, transfer="srgb"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.write_bytes(b""), "found an empty file"),
        (lambda path: path.write_bytes(path.read_bytes()[:300]), "cannot be developed"),
        (lambda path: path.write_bytes(path.read_bytes()[:-2000]), "cannot be developed"),
        (lambda path: path.write_bytes(b"hello" * 100), "cannot be developed"),
        (lambda path: path.unlink(), r"shots of view cup .*found none at 90"),
        (
            lambda path: path.with_suffix(".jpg").write_bytes(b""),
            "one picture of cup at 90 degrees, found cup.dng and cup.jpg",
        ),
    ],
)
def test_damaged_files(tmp_path: Path, change: object, message: str) -> None:
    write_shots(tmp_path / "in", smooth_light(64, 96))
    change(tmp_path / "in" / "90" / "cup.dng")  # type: ignore[operator]
    with pytest.raises(PolarguideError, match=message):
        prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    assert not (tmp_path / "out" / "scene.json").exists()


def test_without_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.nef").write_bytes(b"raw")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(PolarguideError, match=r"not installed. Install it with .*rawpy"):
        read_camera_raw(tmp_path / "a.nef", UNIT)


class Recorder:
    """Takes the place of rawpy's file and keeps what it is asked for."""

    def __init__(self, flip: int) -> None:
        self.sizes = SimpleNamespace(raw_width=6, raw_height=4, flip=flip)
        self.asked: dict = {}

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def postprocess(self, **settings: object) -> np.ndarray:
        self.asked = settings
        self.sizes.flip = 0  # as LibRaw does with user_flip
        return np.zeros((4, 6, 3), np.uint16)


@pytest.mark.parametrize(("flip", "code"), [(0, 1), (3, 3), (5, 8), (6, 6)])
def test_what_libraw_is_asked_for(tmp_path: Path, flip: int, code: int) -> None:
    (tmp_path / "a.nef").write_bytes(b"raw")
    seen = []

    def opener(data: io.BytesIO) -> Recorder:
        assert data.read() == b"raw"
        seen.append(Recorder(flip))
        return seen[-1]

    pixels, found = read_camera_raw(tmp_path / "a.nef", (2.0, 1.0, 1.5), opener=opener)
    assert (pixels.shape, found) == ((4, 6, 3), code)
    asked = seen[0].asked
    assert asked["gamma"] == (1.0, 1.0)
    assert asked["output_bps"] == 16
    assert asked["no_auto_bright"] is True
    assert asked["adjust_maximum_thr"] == 0.0
    assert asked["user_wb"] == [2.0, 1.0, 1.5, 1.0]
    assert (asked["use_camera_wb"], asked["use_auto_wb"], asked["user_flip"]) == (False, False, 0)


def test_white_balance_is_for_camera_raw(tmp_path: Path) -> None:
    from camera_files import write_shots as write_pictures

    write_pictures(tmp_path / "in", "v", behind(smooth_light()))
    with pytest.raises(PolarguideError, match="--white-balance: expected none for pictures"):
        prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, white_balance="1,2,3"))
