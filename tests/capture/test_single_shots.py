"""Angles of photographs from their names, and what their files say about the exposure."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from polarguide.capture.calibration import Calibration
from polarguide.capture.filter.exif import apply_orientation, orientation_calibration
from polarguide.capture.filter.exif_exposure import read_taken, taken
from polarguide.capture.filter.single_shots import split_name
from polarguide.capture.polarizer_angles import Angle, angle_labels, turned
from polarguide.polarizer import malus
from polarguide.synth.sensor import FilterShot, Sensor, behind_filter, exif_tags, filter_jpeg


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
    assert turned(30, Calibration(sense="cw")) == 150
    assert turned(30, Calibration(zero=-40)) == 170
    assert turned("unknown", Calibration(zero=10)) == "unknown"


def test_the_sheet_passes_what_geometry_says() -> None:
    """Fields by hand: on the axis the angle itself; elsewhere what is perpendicular to ray and absorption axis."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(4, 5, 3)) * [0.4, 0.4, 0] + [0, 0, 1]
    rays[0, 0] = (0, 0, 1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for degrees in (0.0, 30.0, 135.0):
        angle = np.radians(degrees)
        absorbed = np.array([np.sin(angle), np.cos(angle), 0])
        passed = np.cross(rays, absorbed)
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
        light = read_taken(path).light
        assert light == pytest.approx(2**shot.stops / 60 * 100 / 64, rel=1e-4)
        assert cv2.imread(str(path)).shape[:2] == (16, 24)  # OpenCV turns it upright
    plain = FilterShot(0, 0.3, noted=False)
    assert taken(filter_jpeg(stokes, rays, plain, 0, np.random.default_rng(0), Sensor())).light is None


def test_damaged_exif_says_nothing() -> None:
    whole = b"\xff\xd8\xff\xe1" + struct.pack(">H", 8 + len(exif_tags(1, Fraction(1, 50)))) + b"Exif\0\0"
    tags = exif_tags(1, Fraction(1, 50))
    assert taken(whole + tags + b"\xff\xda").light == pytest.approx(0.02 * 100 / 64)
    for length in range(len(tags)):
        light = taken(whole + tags[:length].ljust(len(tags), b"\xff") + b"\xff\xda").light
        assert light is None or light > 0
    for tiff in (b"", b"II*\0", b"MM\0*" + b"\xff" * 40, b"MM\0*\0\0\0\x08" + b"\xff" * 400):
        assert taken(tiff).light is None
