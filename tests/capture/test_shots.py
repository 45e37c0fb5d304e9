"""Photographs through a filter: camera raw, single shots, captures of others."""

from __future__ import annotations

import io
import json
import math
import re
import struct
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from camera_files import ANGLES, behind, read_invalid, read_polar, smooth_light
from faults import Fault

from polarguide.capture.calibration import Calibration, apply_orientation, orientation_calibration
from polarguide.capture.exposures import Angle, angle_labels, split_name, turned
from polarguide.capture.filter.camera_files import exif_data, read_camera_raw, read_exposure_data
from polarguide.geometry.polarizer import malus
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.ring_scale import BAND, place, ring_scale
from polarguide_synth.sensor import FilterShot, Sensor, behind_filter, exif_tags, filter_jpeg

PLAIN = PrepareSettings(poses="none", gains="none", align=False)


def write_shots(folder: Path, light: np.ndarray, *, orientation: int = 1) -> None:
    pytest.importorskip("rawpy")
    pytest.importorskip("tifffile")
    from raw_photographs import write_dng

    for angle, values in zip(ANGLES, behind(light), strict=True):
        write_dng(folder / str(angle) / "cup.dng", values, orientation=orientation)


def test_raw_shots_come_out_linear_on_one_scale(tmp_path: Path) -> None:
    light = smooth_light(64, 96)
    write_shots(tmp_path / "in", light)
    assert prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN).views == ["cup"]
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


def test_saturation(tmp_path: Path) -> None:
    light = smooth_light(64, 96)
    light[:, 20:26, 30:36] *= 3
    write_shots(tmp_path / "in", light)
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    polar, invalid = read_polar(tmp_path / "out", "cup"), read_invalid(tmp_path / "out", "cup")
    assert invalid[21:25, 31:35].all()
    expected = behind(light)
    inside = ~invalid
    inside[:2] = inside[-2:] = inside[:, :2] = inside[:, -2:] = inside[18:28, 28:38] = False
    np.testing.assert_allclose(polar[:, inside], expected[:, inside], atol=4e-3)


def test_a_sensor_that_clips_is_at_full_scale(tmp_path: Path) -> None:
    """LibRaw's own rounding would leave the white level of 12 bits without black at 65534."""
    pytest.importorskip("rawpy")
    from raw_photographs import write_dng

    write_dng(tmp_path / "a.dng", np.full((32, 48, 3), 1.5), black=0)
    assert (read_camera_raw(tmp_path / "a.dng")[0] == 65535).all()


@pytest.mark.parametrize("black", [0, 528])
def test_linear_dng_clips_at_full_scale(tmp_path: Path, black: int) -> None:
    """Three colors at every pixel, as telephones write them, with a black level."""
    pytest.importorskip("rawpy")
    from raw_photographs import write_linear_dng

    light = np.linspace(0, 1.2, 48 * 64 * 3).reshape(48, 64, 3)
    write_linear_dng(tmp_path / "a.dng", light, black=black)
    pixels, _ = read_camera_raw(tmp_path / "a.dng")
    np.testing.assert_allclose(pixels / 65535, np.minimum(light, 1), atol=2e-4)
    assert (pixels[light > 1.001] == 65535).all()


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
    Fault("--transfer", expected="auto or linear").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", replace(PLAIN, transfer="srgb")
    )


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda path: path.write_bytes(b""), Fault(found="an empty file")),
        (lambda path: path.write_bytes(path.read_bytes()[:300]), Fault(found="cannot be developed")),
        (lambda path: path.write_bytes(path.read_bytes()[:-2000]), Fault(found="cannot be developed")),
        (lambda path: path.write_bytes(b"hello" * 100), Fault(found="cannot be developed")),
        (lambda path: path.unlink(), Fault(expected="shots of view cup", found="none at 90")),
        (
            lambda path: path.with_suffix(".jpg").write_bytes(b""),
            Fault(expected="one picture of cup at 90 degrees", found="cup.dng and cup.jpg"),
        ),
    ],
)
def test_damaged_files(tmp_path: Path, change: object, fault: Fault) -> None:
    write_shots(tmp_path / "in", smooth_light(64, 96))
    change(tmp_path / "in" / "90" / "cup.dng")  # type: ignore[operator]
    fault.raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", PLAIN)
    assert not (tmp_path / "out" / "scene.json").exists()


def test_without_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.nef").write_bytes(b"raw")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    Fault(found="not installed", remedy="Install it with").raised_by(read_camera_raw, tmp_path / "a.nef")


class Recorder:
    """Takes the place of rawpy's file and keeps what it is asked for."""

    def __init__(self, flip: int) -> None:
        self.sizes = SimpleNamespace(raw_width=6, raw_height=4, flip=flip)
        self.raw_type = SimpleNamespace(name="Flat")
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

    pixels, found = read_camera_raw(tmp_path / "a.nef", opener=opener)
    assert (pixels.shape, found) == ((4, 6, 3), code)
    asked = seen[0].asked
    assert (asked["gamma"], asked["output_bps"]) == ((1.0, 1.0), 16)
    assert asked["no_auto_bright"] is True
    assert (asked["adjust_maximum_thr"], asked["user_wb"]) == (0.0, [1.0, 1.0, 1.0, 1.0])
    assert (asked["use_camera_wb"], asked["use_auto_wb"], asked["user_flip"]) == (False, False, 0)


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("cup_045", ("cup", 45.0)),
        ("cup-0", ("cup", 0.0)),
        ("cup 165", ("cup", 165.0)),
        ("IMG_0012_a30", ("IMG_0012", 30.0)),
        ("IMG_0012_pol7.5", ("IMG_0012", 7.5)),
        ("v3_Angle-20", ("v3", 20.0)),
        ("v3_22deg", ("v3", 22.0)),
        ("v3_i135", ("v3", 135.0)),
        ("cup_-45", ("cup", -45.0)),
        ("cup -30deg", ("cup", -30.0)),
        ("cup - 45", ("cup", 45.0)),
        ("cup-45", ("cup", 45.0)),
        ("v3.unknown", ("v3", "unknown")),
        ("v3_NONE", ("v3", "none")),
        ("IMG_0012", None),
        ("img_012", None),
        ("img_180", None),
        ("img_12.5", None),
        ("2026-05-01 12.31.44", None),
        ("cup_a999", None),
        ("045", None),
        ("cup045", None),
        ("nonesuch", None),
    ],
)
def test_names(stem: str, expected: tuple[str, Angle] | None) -> None:
    assert split_name(stem) == expected


def test_labels_are_unique_and_say_the_angle() -> None:
    angles: list[Angle] = [0.0, 45, 7.5, 179.999, "unknown", "unknown", "none", 7.5001]
    assert angle_labels(angles) == [
        "000", "045", "007.5", "180", "unknown", "unknown-2", "none", "007.5-2"
    ]  # fmt: skip


@pytest.mark.parametrize("code", range(1, 9))
def test_angles_turn_with_pictures(code: int) -> None:
    """A ramp of Stokes vectors in double precision: turning what passed is passing what was turned."""
    y, x = np.mgrid[:5, :7] / 7.0
    stokes = np.stack([1 + 0.2 * x, 0.3 * x - 0.1 * y, 0.2 * y + 0.1])
    upright = np.stack([apply_orientation(plane, code) for plane in stokes])
    # The frame turns with the pixels: a quarter changes the signs of both, a mirror that of S2.
    upright[1:] *= -1.0 if code in (5, 6, 7, 8) else 1.0
    upright[2] *= -1.0 if code in (2, 4, 5, 7) else 1.0
    for angle in (0.0, 20.0, 45.0, 110.0, -30.0, 390.0):
        found = turned(angle, orientation_calibration(code))
        assert isinstance(found, float)
        passed = apply_orientation(malus(stokes, np.radians(angle)), code)
        np.testing.assert_allclose(passed, malus(upright, np.radians(found)), atol=1e-12)


def test_sense_and_zero() -> None:
    assert (turned(30, Calibration(sense="cw")), turned(30, Calibration(zero=-40))) == (150, 170)
    assert turned("unknown", Calibration(zero=10)) == "unknown"


def test_the_sheet_passes_what_geometry_says() -> None:
    """Fields by hand: on the axis the angle itself; elsewhere what is perpendicular to ray and absorption axis."""
    rays = np.random.default_rng(0).normal(size=(4, 5, 3)) * [0.4, 0.4, 0] + [0, 0, 1]
    rays[0, 0] = (0, 0, 1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for degrees in (0.0, 30.0, 135.0):
        angle = np.radians(degrees)
        passed = np.cross(rays, np.array([np.sin(angle), np.cos(angle), 0]))
        passed /= np.linalg.norm(passed, axis=-1, keepdims=True)
        x, y, z = np.moveaxis(rays, -1, 0)
        # The smallest rotation from the axis to the ray (Rodrigues), applied to right and up.
        across = np.stack([-y, x, 0 * x], axis=-1)

        def carried(vector: np.ndarray, across: np.ndarray = across, z: np.ndarray = z) -> np.ndarray:
            side = np.cross(across, vector)
            return vector + side + np.cross(across, side) / (1 + z)[..., None]

        right, up = carried(np.array([1.0, 0, 0])), carried(np.array([0, -1.0, 0]))
        aolp = np.arctan2((passed * up).sum(-1), (passed * right).sum(-1))
        # Light polarized fully along what passes: nothing is absorbed. Across it: all is.
        for offset, share in ((0.0, 1.0), (np.pi / 2, 0.0)):
            full = np.stack([np.ones_like(x), np.cos(2 * (aolp + offset)), np.sin(2 * (aolp + offset))])
            through = behind_filter(np.repeat(full[..., None], 3, axis=-1), rays, degrees)
            np.testing.assert_allclose(through, share, atol=1e-12)
        assert np.cos(2 * (aolp[0, 0] - angle)) == pytest.approx(1)


def test_what_files_say_about_exposure(tmp_path: Path) -> None:
    rays = np.zeros((16, 24, 3)) + [0.0, 0.0, 1.0]
    stokes = np.zeros((3, 16, 24, 3)) + 0.3
    for shot in (FilterShot(0, 1.0), FilterShot(0, -0.5, 6)):
        path = tmp_path / f"{shot.orientation}.jpg"
        path.write_bytes(filter_jpeg(stokes, rays, shot, 0, np.random.default_rng(0), Sensor()))
        assert read_exposure_data(path).light == pytest.approx(2**shot.stops / 60 * 100 / 64, rel=1e-4)
        assert cv2.imread(str(path)).shape[:2] == (16, 24)  # OpenCV turns it upright
    plain = FilterShot(0, 0.3, noted=False)
    assert exif_data(filter_jpeg(stokes, rays, plain, 0, np.random.default_rng(0), Sensor())).light is None


def test_damaged_exif_says_nothing() -> None:
    whole = b"\xff\xd8\xff\xe1" + struct.pack(">H", 8 + len(exif_tags(1, Fraction(1, 50)))) + b"Exif\0\0"
    tags = exif_tags(1, Fraction(1, 50))
    rest = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()[2:]
    assert exif_data(whole + tags + rest).light == pytest.approx(0.02 * 100 / 64)
    for length in range(len(tags)):
        light = exif_data(whole + tags[:length].ljust(len(tags), b"\xff") + rest).light
        assert light is None or light > 0
    for tiff in (b"", b"II*\0", b"MM\0*" + b"\xff" * 40, b"MM\0*\0\0\0\x08" + b"\xff" * 400):
        assert exif_data(tiff).light is None


SVG = "{http://www.w3.org/2000/svg}"


def test_sizes_are_millimeters() -> None:
    root = ElementTree.fromstring(ring_scale(70.0))
    box = [float(value) for value in root.attrib["viewBox"].split()]
    assert (root.attrib["width"], root.attrib["height"]) == (f"{box[2]:.3f}mm", f"{box[3]:.3f}mm")
    radii = sorted(float(circle.attrib["r"]) for circle in root.iter(f"{SVG}circle"))
    assert radii == [35.0, 35.0 + BAND]
    lines = [{k: float(line.attrib[k]) for k in ("x1", "x2", "y1", "y2")} for line in root.iter(f"{SVG}line")]
    assert any(abs(line["x2"] - line["x1"] - 50) < 1e-9 and line["y1"] == line["y2"] for line in lines)
    for line in lines:
        assert all(0 <= line[k] <= box[2 if k[0] == "x" else 3] for k in line)


def test_angles_count_from_behind_the_camera_and_are_read_from_the_front() -> None:
    """A field at a degrees points to (cos a, -sin a) in the picture; from the front, right and left change places."""
    root = ElementTree.fromstring(ring_scale(58.0))
    middle = float(root.attrib["viewBox"].split()[2]) / 2
    seen: dict[int, int] = {}
    for text in root.iter(f"{SVG}text"):
        if not re.fullmatch(r"\d+", text.text or ""):
            continue
        degrees = int(text.text or "")
        x, y = float(text.attrib["x"]) - middle, float(text.attrib["y"]) - middle
        right, up = -x, -y  # of the picture
        turn = math.degrees(math.atan2(up, right)) % 180
        assert min(abs(turn - degrees), 180 - abs(turn - degrees)) < 0.01
        seen[degrees] = seen.get(degrees, 0) + 1
    assert seen == {angle: 2 for angle in range(0, 180, 15)}
    assert place(90, 0, 1) == pytest.approx((0, -1))
    assert place(45, 0, 1) == pytest.approx((-math.sqrt(0.5), -math.sqrt(0.5)))
