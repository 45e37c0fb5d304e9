"""``prepare`` on published datasets: light, masks, cameras and the sense of angles, from known ones."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from camera_files import behind, read_invalid, read_polar
from dataset_files import (
    DISTORTION,
    HEIGHT,
    WIDTH,
    WRITERS,
    disc,
    light_of,
    pisr_inner,
    poses,
    write_gnerp,
    write_nersp,
    write_pandora,
    write_pisr,
)
from faults import Fault
from heard import Heard
from tiny_capture import write_picture

from polarguide.capture import load_scene
from polarguide.capture.calibration import Calibration
from polarguide.capture.formats.pictures import decode_mask
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.capture import measure_view, read_capture
from polarguide.inspection.picture_checks import picture_checks
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

# The light of these tests has no outlines: nothing tells the sense of NeRSP's and NeISF's angles.
pytestmark = pytest.mark.filterwarnings("ignore:The sense of .* is uncertain")
PLAIN = PrepareSettings(poses="none", gains="none")
NAMES = {
    "pandora": ["01", "02", "03", "04"],
    "pisr": ["000", "001", "002", "003"],
    "nersp": ["0000", "0001", "0002", "0003"],
    "neisf": ["img_001", "img_002", "img_003", "img_004"],
    "gnerp": ["0", "1", "2", "3"],
    "phygap": ["000", "001", "002", "003"],
}
# PANDORA's files share an exponent between channels, GNeRP's pictures have 8 bits.
TOLERANCE = {"pandora": 1e-2, "nersp": 2e-5, "neisf": 2e-5, "gnerp": 1e-2, "phygap": 2e-5}


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


def written(name: str, root: Path) -> Path:
    if name in ("neisf", "phygap"):
        pytest.importorskip("OpenEXR")
    return WRITERS[name](root)


def channels_of(name: str, stokes: np.ndarray) -> np.ndarray:
    """What the dataset can hold: GNeRP's angle and degree of polarization are those of green."""
    if name != "gnerp":
        return stokes
    return np.concatenate([stokes[:1], (stokes[1:, ..., 1:2] / stokes[:1, ..., 1:2]) * stokes[:1]])


@pytest.mark.parametrize("name", sorted(TOLERANCE))
def test_light_and_masks(tmp_path: Path, name: str) -> None:
    source = written(name, tmp_path / "in")
    heard = Heard()
    done = prepare_scene(source, tmp_path / "out", PLAIN, heard)
    found = summary(tmp_path / "out")
    assert found["format"] == name  # detected
    assert done.views == NAMES[name]
    largest = max(behind(channels_of(name, light_of(index))).max() for index in range(4))
    assert found["scale"] == pytest.approx(1 / largest, rel=0.01)
    for index, view in enumerate(done.views):
        expected = behind(channels_of(name, light_of(index))) * found["scale"]
        np.testing.assert_allclose(read_polar(tmp_path / "out", view), expected, atol=TOLERANCE[name])
        path = tmp_path / "out" / "masks" / f"{view}.png"
        np.testing.assert_array_equal(decode_mask(path, path.read_bytes(), any_value=False), disc())
        assert not read_invalid(tmp_path / "out", view).any()
    assert found["pair_sums"].startswith("n/a")
    assert any("Four-angle sum check: n/a" in text for text in heard.said)
    capture = read_capture(tmp_path / "out")
    measured = [measure_view(inspected, 1.5) for inspected in capture.views]
    verdicts = {check.key: check.verdict for check in picture_checks(capture, measured, None)}
    assert [verdicts[key] for key in ("pair_sums", "encoding", "exposure", "noise")] == ["n/a"] * 4
    assert found["calibration"]["sense"] == ("cw" if name == "nersp" else "ccw")


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_cameras(tmp_path: Path, name: str) -> None:
    source = written(name, tmp_path / "in")
    heard = Heard()
    done = prepare_scene(source, tmp_path / "out", PrepareSettings(gains="none"), heard)
    assert done.posed
    assert done.views == NAMES[name]
    scene = load_scene(tmp_path / "out")
    for view, (rotation, translation) in zip(scene.views, poses(), strict=True):
        camera = view.camera
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-6)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-6)
        inner = (camera.fx, camera.fy, camera.cx, camera.cy)
        if name == "neisf":
            assert inner == pytest.approx((90, 90, WIDTH / 2, HEIGHT / 2))
        elif name != "pisr":
            assert inner == pytest.approx((90, 92, 33, 23))
    points = summary(tmp_path / "out")["points"]
    assert points["from"] == "random samples in the hull of the masks"
    assert points["count"] == len(scene.points)
    assert any("sampled at random in the hull of the masks" in text for text in heard.said)
    # The samples lie where the discs of all views meet: around the origin.
    assert np.abs(scene.points.numpy().mean(axis=0)).max() < 0.5
    assert np.linalg.norm(scene.points.numpy(), axis=1).max() < 2.5


def test_pisr_is_developed_undistorted_and_made_linear(tmp_path: Path) -> None:
    """Light that is a function of the ray, behind a distorted lens and a camera's gamma."""
    inner = pisr_inner() / [[4], [4], [1]]  # of the sensor, a quarter of 1224x1024 times two
    inner[:2, 2] += 0.5 * (1 / 4) - 0.0  # OpenCV's pixels -> COLMAP's, at a quarter
    full = pycolmap.Camera(
        model="FULL_OPENCV", width=306, height=256,
        params=[inner[0, 0], inner[1, 1], inner[0, 2], inner[1, 2], *DISTORTION, 0, 0, 0],
    )  # fmt: skip

    def rays_of(camera: pycolmap.Camera) -> np.ndarray:
        rows, columns = np.mgrid[: camera.height, : camera.width]
        places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
        return camera.cam_from_img(places).T.reshape(2, camera.height, camera.width)

    def light(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        s0 = (0.8 + 0.3 * np.sin(9 * x) * np.cos(7 * y))[..., None] * np.ones(3)
        return np.stack([s0, s0 * 0.3 * np.cos(5 * x)[..., None], s0 * 0.3 * np.sin(5 * y)[..., None]])

    write_pisr(tmp_path / "in", lambda _: light(*rays_of(full)), gamma=0.8)
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", PrepareSettings(gains="none"), heard)
    assert any("power of 0.8" in text for text in heard.said)
    found = summary(tmp_path / "out")
    assert found["levels"]["bits"] == 12
    assert found["prepare"]["views"]["000"]["warp"]["model"] == "FULL_OPENCV"
    camera = load_scene(tmp_path / "out").views[0].camera
    straight = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height,
        params=[camera.fx, camera.fy, camera.cx, camera.cy],
    )  # fmt: skip
    invalid = read_invalid(tmp_path / "out", "000")
    assert invalid.mean() < 0.05
    expected = behind(light(*rays_of(straight))) * found["scale"]
    error = np.abs(read_polar(tmp_path / "out", "000") - expected)[:, 2:-2, 2:-2][:, ~invalid[2:-2, 2:-2]]
    assert error.max() < 0.01


@pytest.mark.parametrize(("sense", "zero"), [("ccw", 0.0), ("cw", 0.0), ("cw", 90.0), ("ccw", 20.0)])
def test_the_sense_can_be_overridden(tmp_path: Path, sense: str, zero: float) -> None:
    """NeRSP's files hold S2 with the other sign; told that they count otherwise, they are taken so."""
    write_nersp(tmp_path / "in")
    settings = replace(PLAIN, calibration=Calibration(sense=sense, zero=zero))
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    found = summary(tmp_path / "out")
    s0, s1, s2 = light_of(0)
    if sense == "ccw":
        s2 = -s2
    cosine, sine = np.cos(2 * np.radians(zero)), np.sin(2 * np.radians(zero))
    turned = np.stack([s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine])
    polar = read_polar(tmp_path / "out", "0000")
    np.testing.assert_allclose(polar, behind(turned) * found["scale"], atol=3e-5)
    assert found["calibration"] == {"order": [0, 45, 90, 135], "sense": sense, "zero_degrees": zero}


def test_highlights_clip_and_negative_intensities_are_counted(tmp_path: Path) -> None:
    def light(index: int) -> np.ndarray:
        stokes = light_of(index)
        if index == 0:
            stokes[:, 3, 5] *= 100
            stokes[0, 10, 10] *= 0.1  # more polarized than light can be
            stokes[0, 20, 20] = np.nan
        return stokes

    write_nersp(tmp_path / "in", light)
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN, heard)
    found = summary(tmp_path / "out")
    assert np.argwhere(read_invalid(tmp_path / "out", "0000")).tolist() == [[3, 5], [20, 20]]
    assert 0 < found["negative_share"] < 2e-3
    assert found["clipped_share"] == pytest.approx(0.25 / (HEIGHT * WIDTH), abs=2e-6)
    assert any("negative" in text for text in heard.said)
    assert any("not finite" in text for text in heard.said)
    assert found["full_scale"] == pytest.approx(2 * behind(light_of(0)).max(), rel=0.02)


def test_gnerp_pictures_may_be_linear(tmp_path: Path) -> None:
    write_gnerp(tmp_path / "in")
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "srgb", PLAIN, heard)
    assert any("srgb and made linear" in text for text in heard.said)
    assert any("R, G and B" in text for text in heard.said)
    prepare_scene(tmp_path / "in", tmp_path / "linear", replace(PLAIN, transfer="linear"))
    assert read_polar(tmp_path / "linear", "0").mean() > 1.1 * read_polar(tmp_path / "srgb", "0").mean()


def test_pandora_may_count_from_zero(tmp_path: Path) -> None:
    write_pandora(tmp_path / "in")
    for path in sorted((tmp_path / "in").glob("*/*")):
        path.rename(path.with_name(f"{int(path.name[:2]) - 1:02d}{path.name[2:]}"))
    prepare_scene(tmp_path / "in", tmp_path / "out", PrepareSettings())
    cameras = [view.camera for view in load_scene(tmp_path / "out").views]
    for camera, (rotation, _) in zip(cameras, poses(), strict=True):
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-6)


def test_polanalyser_agrees_on_the_written_pictures(tmp_path: Path) -> None:
    """Degree and angle of polarization of the four written pictures, by an independent program."""
    reference = pytest.importorskip("polanalyser")
    analyzers = [reference.polarizer(np.radians(angle)) for angle in ANGLES]
    for name in ("pandora", "nersp"):
        write = {"pandora": write_pandora, "nersp": write_nersp}[name]
        prepare_scene(write(tmp_path / name), tmp_path / f"{name} out", PLAIN)
        stokes = reference.calcStokes(
            list(read_polar(tmp_path / f"{name} out", NAMES[name][0])[..., 1]), analyzers
        )
        s0, s1, s2 = light_of(0)[..., 1]
        np.testing.assert_allclose(reference.cvtStokesToDoLP(stokes), np.hypot(s1, s2) / s0, atol=0.02)
        assert np.abs(np.sin(reference.cvtStokesToAoLP(stokes) - np.arctan2(s2, s1) / 2)).max() < 0.03


def test_polanalyser_agrees_on_pisr(tmp_path: Path) -> None:
    """Stokes vectors of the raw file itself, demosaiced by an independent program."""
    reference = pytest.importorskip("polanalyser")
    write_pisr(tmp_path / "in")
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, demosaic="full"))
    raw = np.load(tmp_path / "in" / "raw" / "000.npy")
    pictures = reference.demosaicing(raw, reference.COLOR_PolarRGB)
    theirs = np.stack([picture.astype(float)[..., ::-1] for picture in pictures]) / 4095
    assert np.abs(read_polar(tmp_path / "out", "000") - theirs)[:, 4:-4, 4:-4].max() < 2 / 4095


def test_colmap_poses_and_sfm_may_be_asked_for_instead(tmp_path: Path) -> None:
    write_nersp(tmp_path / "in")
    Fault(expected="a COLMAP model").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", PrepareSettings(poses=str(tmp_path))
    )
    Fault(found="views registered").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", PrepareSettings(poses="sfm")
    )


def test_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("OpenEXR")
    source = written("neisf", tmp_path / "in")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    Fault(found="not installed", remedy="Install it with").raised_by(
        prepare_scene, source, tmp_path / "out", PLAIN
    )


def test_nersp_under_other_names(tmp_path: Path) -> None:
    """Masks beside the pictures, I-sum, cameras_new.npz with padded numbers."""
    root = WRITERS["nersp"](tmp_path / "in")
    shutil.rmtree(root / "input_azimuth_maps")
    (root / "image").rename(root / "I-sum")
    with np.load(root / "cameras.npz") as arrays:
        padded = {f"{key[:-1]}{int(key[-1]):02d}": arrays[key] for key in arrays}
    np.savez(root / "cameras_new.npz", **padded)
    (root / "cameras.npz").unlink()
    for index in range(4):
        write_picture(root / "mask" / f"{index:04d}.png", disc().astype(float), bits=8)
    assert prepare_scene(root, tmp_path / "out", PLAIN).views == NAMES["nersp"]
    path = tmp_path / "out" / "masks" / "0000.png"
    np.testing.assert_array_equal(decode_mask(path, path.read_bytes(), any_value=False), disc())
