"""``prepare`` on shots through a rotating filter."""

from __future__ import annotations

import contextlib
import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import ANGLES, behind, busy_light, read_invalid, read_polar, smooth_light, write_shots
from faults import Fault
from tiny_capture import encode_srgb, write_picture

from polarguide.capture.calibration import apply_orientation
from polarguide.capture.develop import Shift, estimate_shifts, shift_notes
from polarguide.capture.filter.camera_files import orientation
from polarguide.capture.filter.shots import find_shots
from polarguide.core.errors import PolarguideWarning
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

PLAIN = PrepareSettings(poses="none", gains="none", align=False, transfer="linear")
CORNERS = ["top left", "top right", "bottom right", "bottom left"]


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


@pytest.mark.parametrize(
    "names",
    [
        [f"{angle}/cup.png" for angle in ANGLES],
        [f"I-{angle:02d}/cup.tif" for angle in ANGLES],
        [f"{angle:03d}/cup.tiff" for angle in ANGLES],
        [f"image_{angle}/cup.png" for angle in ANGLES],
        [f"cup/{angle}.png" for angle in ANGLES],
        [f"2026-05-01/cup_pol{angle}.tif" for angle in ANGLES],
        [f"cup_{angle}.png" for angle in ANGLES],
        [f"cup-I{angle:02d}.tif" for angle in ANGLES],
        [f"cup {angle:03d}deg.png" for angle in ANGLES],
    ],
)
def test_folders_and_suffixes(tmp_path: Path, names: list[str]) -> None:
    light = behind(smooth_light())
    for name, values in zip(names, light, strict=True):
        write_picture(tmp_path / "in" / name, values)
    assert prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN).views == ["cup"]
    np.testing.assert_allclose(read_polar(tmp_path / "out", "cup"), light, atol=1e-5)
    assert not read_invalid(tmp_path / "out", "cup").any()


@pytest.mark.parametrize(("suffix", "bits"), [(".png", 8), (".tif", 8), (".jpg", 8), (".png", 16)])
@pytest.mark.parametrize("srgb", [True, False])
def test_transfer_is_told_by_the_light(tmp_path: Path, suffix: str, bits: int, srgb: bool) -> None:
    light = behind(smooth_light(96, 128, peak=0.9))
    write_shots(tmp_path / "in", "v", light, suffix=suffix, bits=bits, srgb=srgb)
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, transfer="auto"))
    assert summary(tmp_path / "out")["transfer"] == ("srgb" if srgb else "linear")
    assert np.abs(read_polar(tmp_path / "out", "v") - light).mean() < 0.01


def test_files_named_like_the_angles_alone_are_one_view(tmp_path: Path) -> None:
    for angle, values in zip(ANGLES, behind(smooth_light()), strict=True):
        write_picture(tmp_path / "cup" / f"I{angle}.png", values, bits=16)
    assert prepare_scene(tmp_path / "cup", tmp_path / "out", PLAIN).views == ["cup"]


def test_folders_of_days_are_one_capture(tmp_path: Path) -> None:
    for day, view in (("2026-05-01", "a"), ("2026-05-02", "b")):
        write_shots(tmp_path / "in" / day, view, behind(smooth_light()))
    for angle in ANGLES:  # of one view in four folders, to two views in two
        for day, view in (("2026-05-01", "a"), ("2026-05-02", "b")):
            folder = tmp_path / "in" / day
            (folder / str(angle) / f"{view}.png").rename(folder / f"{view}_{angle}.png")
            (folder / str(angle)).rmdir()
    assert prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN).views == ["a", "b"]
    twice = tmp_path / "in" / "2026-05-02" / "a_0.png"
    twice.write_bytes((tmp_path / "in" / "2026-05-01" / "a_0.png").read_bytes())
    both = "2026-05-01/a_0.png and 2026-05-02/a_0.png"
    Fault(expected="one picture of a at 0 degrees", found=both).raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "again", PLAIN
    )


def test_folders_below_are_not_read_in_place_of_mosaics(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", np.zeros((64, 64), np.uint8))
    write_picture(tmp_path / "in" / "old" / "a_0.png", behind(smooth_light())[0])
    assert find_shots(tmp_path / "in", nested=True) == {}


def test_shots_under_the_numbers_of_the_camera_are_named(tmp_path: Path) -> None:
    for k, (angle, values) in enumerate(zip(ANGLES, behind(smooth_light()), strict=True)):
        for view in range(2):
            write_picture(tmp_path / "in" / str(angle) / f"DSC_{4 * view + k}.png", values)
    Fault(expected="equal names of the four shots", found="2 files in each").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", PLAIN
    )


def test_floating_point_pictures(tmp_path: Path) -> None:
    light = behind(smooth_light())
    for angle, values in zip(ANGLES, light, strict=True):
        (tmp_path / "in" / str(angle)).mkdir(parents=True)
        stored = values[..., ::-1].astype(np.float32).copy()
        stored[3, 4] = 1.7
        assert cv2.imwrite(str(tmp_path / "in" / str(angle) / "v.tif"), stored)
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    invalid = read_invalid(tmp_path / "out", "v")
    assert invalid[3, 4]
    assert invalid.sum() == 1
    assert np.abs(read_polar(tmp_path / "out", "v") - light)[:, ~invalid].max() < 2e-5
    assert cv2.imwrite(str(tmp_path / "in" / "0" / "v.tif"), (light[0] * 4000).astype(np.float32))
    Fault(expected="floating-point values from 0 to 1").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out2", PLAIN
    )


@pytest.mark.parametrize(("suffix", "transfer"), [(".jpg", "srgb"), (".png", "linear")])
def test_unpolarized_light_leaves_the_transfer_undecided(tmp_path: Path, suffix: str, transfer: str) -> None:
    """Files of 8 bits that may be sRGB are taken as linear with a warning."""
    write_shots(tmp_path / "in", "v", np.full((4, 48, 64, 3), 0.4), suffix=suffix, bits=8)
    doubtful = pytest.warns(PolarguideWarning, match="state no encoding")
    with doubtful if suffix == ".png" else contextlib.nullcontext():
        prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, transfer="auto"))
    found = summary(tmp_path / "out")
    assert found["transfer"] == transfer
    assert any("too few polarized pixels" in note for note in found["notes"])


def with_orientation(path: Path, code: int) -> None:
    """Put an EXIF orientation into a JPEG file."""
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 274, 3, 1, code, 0, 0)
    block = b"Exif\0\0" + tiff
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:])


@pytest.mark.parametrize("code", range(1, 9))
def test_exif_turns_pixels_and_angles(tmp_path: Path, code: int) -> None:
    """A camera turned by the hand: what is stored, turned as EXIF says, is the scene as it stood upright."""
    stored = smooth_light(96, 128)
    # Light as displayed: pixels turn, and with them the frame that S1 and S2 refer to.
    quarter, mirrored = code in (5, 6, 7, 8), code in (2, 4, 5, 7)
    upright = np.stack([apply_orientation(plane, code) for plane in stored])
    upright[1:] *= -1.0 if quarter else 1.0
    upright[2] *= -1.0 if mirrored else 1.0
    write_shots(tmp_path / "in", "v", behind(stored), suffix=".jpg", bits=8)
    for angle in ANGLES:
        path = tmp_path / "in" / str(angle) / "v.jpg"
        with_orientation(path, code)
        assert orientation(path.read_bytes()) == code
        shown = cv2.imread(str(path))  # OpenCV turns it, too
        assert shown.shape[:2] == upright.shape[1:3]
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    assert np.abs(read_polar(tmp_path / "out", "v") - behind(upright)).max() < 0.03


def moved(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    matrix = np.array([[1, 0, x], [0, 1, y]], float)
    return cv2.warpAffine(
        picture, matrix, picture.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def test_small_shifts_are_found_corrected_and_reported(tmp_path: Path) -> None:
    light = behind(busy_light(96, 128, 3) * np.array([1, 0.25, 0.25])[:, None, None, None])
    shifts = [(0.0, 0.0), (1.6, -0.7), (-0.4, 2.3), (0.0, 0.0)]
    shaken = np.stack([moved(shot, *shift) for shot, shift in zip(light, shifts, strict=True)])
    found = estimate_shifts(shaken.astype(np.float32))
    np.testing.assert_allclose([(s.x, s.y) for s in found], shifts, atol=0.2)
    write_shots(tmp_path / "in", "v", shaken)
    prepare_scene(tmp_path / "in", tmp_path / "on", replace(PLAIN, align=True))
    prepare_scene(tmp_path / "in", tmp_path / "off", PLAIN)
    inside = np.s_[:, 6:-6, 6:-6]
    on, off = (np.abs(read_polar(tmp_path / name, "v") - light)[inside].mean() for name in ("on", "off"))
    assert on < 0.4 * off
    record = summary(tmp_path / "on")["prepare"]["views"]["v"]
    np.testing.assert_allclose(record["shifts"], shifts, atol=0.2)
    assert record["shifts_corrected"][1:3] == [True, True]
    assert read_invalid(tmp_path / "on", "v")[0].all()  # looked beyond the picture there


def test_shifts_that_the_light_contradicts_are_not_believed(tmp_path: Path) -> None:
    """Strong edges of polarization look like shifts; the pair sums tell that nothing moved."""
    light = behind(busy_light(96, 128, 3))
    write_shots(tmp_path / "in", "v", light)
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, align=True))
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), light, atol=1e-5)


def test_shots_without_detail_are_left_as_they_are(tmp_path: Path) -> None:
    write_shots(tmp_path / "in", "v", np.full((4, 48, 64, 3), 0.4))
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, align=True))
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), 0.4, atol=1e-4)
    assert summary(tmp_path / "out")["prepare"]["views"]["v"]["shifts_corrected"] == [False] * 4


def test_exposures_that_differ_from_shot_to_shot(tmp_path: Path) -> None:
    light = behind(smooth_light())
    for view, factor in (("a", 0.96), ("b", 1.05)):
        write_shots(tmp_path / "in", view, light * np.array([factor, 1, factor, 1])[:, None, None, None])
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, gains="auto"))
    found = summary(tmp_path / "out")
    for view, factor in (("a", 0.96), ("b", 1.05)):
        assert found["prepare"]["views"][view]["pair_ratio"] == pytest.approx(factor, abs=1e-3)
        expected = light * np.sqrt(factor) * found["scale"]
        np.testing.assert_allclose(read_polar(tmp_path / "out", view), expected, rtol=2e-3)


def test_shifts_are_doubted_only_where_pair_sums_disagree() -> None:
    """Without detail no shift is found: pair sums tell whether anything moved, and only then it is said."""
    light = behind(np.tile([0.5, 0.1, 0.1], (3, 40, 40, 1)).transpose(3, 1, 2, 0)).astype(np.float32)
    assert shift_notes("v", estimate_shifts(light)) == []
    (note,) = shift_notes("v", [Shift(0, 0, True), *[Shift(0, 0, False)] * 3])
    assert "no shift of the shots at 45, 90, 135 explains it" in note


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1)])
def test_shots_without_detail_are_not_shifted(tmp_path: Path, size: tuple[int, int]) -> None:
    light = behind(np.tile([0.5, 0.1, 0.1], (3, *size, 1)).transpose(3, 1, 2, 0))
    assert estimate_shifts(light.astype(np.float32)) == [Shift(0, 0, True)] * 4
    write_shots(tmp_path / "in", "v", light)
    done = prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, align=True))
    assert done.views == ["v"]


def test_saturated_and_black_pixels_are_invalid(tmp_path: Path) -> None:
    light = behind(smooth_light())
    light[2, 5, 7, 1] = 1.0
    light[:, 20, 30] = 0.0
    light[0, 30, 30] = 0.0
    write_shots(tmp_path / "in", "v", light, bits=8)
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    assert np.argwhere(read_invalid(tmp_path / "out", "v")).tolist() == [[5, 7], [20, 30]]


def test_gray_pictures_and_srgb_decoding(tmp_path: Path) -> None:
    light = behind(smooth_light(color=False))
    for angle, values in zip(ANGLES, light, strict=True):
        write_picture(tmp_path / "in" / f"v_{angle:03d}.png", encode_srgb(values[..., 0]))
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, transfer="srgb"))
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), light, atol=5e-5)
