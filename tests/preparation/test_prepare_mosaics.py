"""Scenes from raw mosaics, with and without a calibration of the sensor."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import (
    ANGLES,
    COLOR,
    MONO,
    behind,
    mosaic,
    read_invalid,
    read_polar,
    smooth_light,
    write_mosaic,
    write_mosaics,
)
from faults import Fault
from heard import Heard
from made_sensor import MadeSensor, made_sensor, true_calibration, write_codes

from polarguide.capture.calibration import Calibration
from polarguide.capture.sensor.analyzers import write_analyzers
from polarguide.geometry.polarizer import stokes_of_four
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings

COLORED = PrepareSettings(sensor="IMX250MYR", poses="none", gains="none", demosaic="quarter")
GRAY = replace(COLORED, sensor="IMX250MZR")


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


def superpixels(light: np.ndarray, pattern: tuple[str, ...], offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Means over 4x4 pixels of the samples there are of each angle and color, sample by sample."""
    height, width = (light.shape[1] - offset[1] % 2) // 4, (light.shape[2] - offset[0] % 2) // 4
    total, count = np.zeros((2, 4, height, width, 3))
    seen = behind(light)
    cells = [row.split() for row in pattern]
    for y in range(4 * height):
        for x in range(4 * width):
            row, column = y + offset[1] % 2, x + offset[0] % 2
            name = cells[(row + offset[1]) % len(cells)][(column + offset[0]) % len(cells)]
            channels = ["RGB".index(name[0])] if name[0] in "RGB" else [0, 1, 2]
            index = ANGLES.index(int(name.lstrip("RGB")))
            total[index, y // 4, x // 4, channels] += seen[index, row, column, channels]
            count[index, y // 4, x // 4, channels] += 1
    return total / count


@pytest.mark.parametrize(
    ("name", "bits", "changes"),
    [
        ("v.png", 8, {}),
        ("v.png", 12, {}),
        ("v.tif", 16, {}),
        ("v.npy", 16, {}),
        ("v.npy", 12, {}),
        ("v.10p.raw", 10, {"packing": "10p", "width": 64, "height": 48}),
        ("v.12p.raw", 12, {"packing": "12p", "width": 64, "height": 48}),
        ("v.12packed.raw", 12, {"packing": "12packed", "width": 64, "height": 48}),
    ],
)
def test_every_container_gives_the_same_scene(tmp_path: Path, name: str, bits: int, changes: dict) -> None:
    light = smooth_light()
    write_mosaic(tmp_path / "in" / name, mosaic(behind(light), COLOR), bits=bits)
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(COLORED, **changes))
    polar = read_polar(tmp_path / "out", Path(name).stem)
    np.testing.assert_allclose(polar, superpixels(light, COLOR), atol=0.7 / (2**bits - 1) + 1e-5)
    found = summary(tmp_path / "out")
    assert (found["levels"]["bits"], found["packing"]) == (bits, changes.get("packing"))
    assert found["scale"] == 1.0


@pytest.mark.parametrize("offset", [(1, 0), (2, 3), (4, 4), (3, 1)])
@pytest.mark.parametrize("pattern", [COLOR, MONO])
def test_regions_of_interest(tmp_path: Path, offset: tuple[int, int], pattern: tuple[str, ...]) -> None:
    color = pattern is COLOR
    light = smooth_light(49, 65, color=color)
    write_mosaic(tmp_path / "in" / "v.png", mosaic(behind(light), pattern, offset))
    settings = replace(COLORED if color else GRAY, offset_x=offset[0], offset_y=offset[1])
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    expected = superpixels(light, pattern, offset if color else (0, 0))
    if not color:
        expected = superpixels(light, tuple(sensor_rows(offset)))
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), expected, atol=4e-5)
    geometry = summary(tmp_path / "out")["prepare"]["views"]["v"]["geometry"]
    assert geometry["crop"] == ([offset[0] % 2, offset[1] % 2] if color else [0, 0])


def sensor_rows(offset: tuple[int, int]) -> list[str]:
    cells = [row.split() for row in MONO]
    return [" ".join(cells[(y + offset[1]) % 2][(x + offset[0]) % 2] for x in range(2)) for y in range(2)]


def test_black_level_dark_frame_and_shifted_bits(tmp_path: Path) -> None:
    light = smooth_light()
    values = mosaic(behind(light), COLOR)
    write_mosaic(tmp_path / "level" / "v.png", values, bits=12, black=240)
    write_mosaic(tmp_path / "shifted" / "v.png", values, bits=12, black=240, shift=4)
    prepare_scene(tmp_path / "level", tmp_path / "a", replace(COLORED, black_level=240))
    prepare_scene(tmp_path / "shifted", tmp_path / "b", replace(COLORED, black_level=240 * 16))
    dark = tmp_path / "level" / "dark.png"
    write_mosaic(dark, np.full(values.shape, 240 / 4095), bits=12)
    prepare_scene(tmp_path / "level", tmp_path / "c", replace(COLORED, dark_frame=str(dark)))
    assert summary(tmp_path / "b")["levels"]["white"] == 65520
    expected = superpixels(light, COLOR)
    for name in "ab":
        np.testing.assert_allclose(read_polar(tmp_path / name, "v"), expected, atol=2e-4)
    # A dark frame is subtracted from the same scale: full scale stays that of the black level, 0.
    np.testing.assert_allclose(read_polar(tmp_path / "c", "v"), expected * (1 - 240 / 4095), atol=2e-4)
    assert sorted(summary(tmp_path / "c")["prepare"]["views"]) == ["v"]


def test_saturated_samples_make_pixels_invalid(tmp_path: Path) -> None:
    values = mosaic(behind(smooth_light()), COLOR)
    values[8, 12] = 1.0
    values[40:44, 20:24] = 0.0
    write_mosaic(tmp_path / "in" / "v.png", values, bits=12)
    settings = replace(COLORED, demosaic="half", register=False)
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    invalid = read_invalid(tmp_path / "out", "v")
    inside = np.zeros_like(invalid)
    inside[3:6, 5:8] = inside[19:23, 9:13] = True
    assert (invalid[4, 6], invalid[20, 10], invalid[21, 11]) == (True, True, True)
    assert not invalid[~inside].any()
    assert read_polar(tmp_path / "out", "v")[:, ~invalid].max() < 1.0
    record = summary(tmp_path / "out")["prepare"]["views"]["v"]
    assert record["clipped_share"] == pytest.approx(1 / values.size, abs=1e-6)
    assert record["dark_share"] == pytest.approx(16 / values.size, abs=1e-6)


@pytest.mark.parametrize("pattern", [COLOR, MONO])
def test_gains_of_the_angles_are_found(tmp_path: Path, pattern: tuple[str, ...]) -> None:
    light = smooth_light(color=pattern is COLOR)
    response = np.array([0.98, 1.0, 0.98, 1.0])[:, None, None, None]
    write_mosaic(tmp_path / "in" / "v.png", mosaic(behind(light) * response, pattern))
    settings = replace(COLORED if pattern is COLOR else GRAY, gains="auto")
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    found = summary(tmp_path / "out")
    assert found["pair_ratio"] == pytest.approx(0.98, abs=0.003)
    assert any("look like polarization" in note for note in found["notes"])
    expected = superpixels(light, pattern) * found["scale"] * np.sqrt(0.98)
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), expected, rtol=0.004)


@pytest.mark.parametrize(
    ("calibration", "angles"),
    [
        (Calibration(order=(90, 45, 0, 135)), (90, 45, 0, 135)),
        (Calibration(sense="cw"), (0, -45, -90, -135)),
        (Calibration(zero=90.0), (90, 135, 180, 225)),
        (Calibration(zero=-45.0, sense="cw"), (-45, -90, -135, -180)),
        (Calibration(zero=20.0), (20, 65, 110, 155)),
        (Calibration(zero=-7.5, sense="cw", order=(0, 135, 90, 45)), (-7.5, -142.5, -97.5, -52.5)),
    ],
)
def test_order_sense_and_zero(tmp_path: Path, calibration: Calibration, angles: tuple[float, ...]) -> None:
    """The sensor's "0" samples saw the light behind the angle that the calibration says, and so on."""
    light = smooth_light(color=False) * 0.9
    write_mosaic(tmp_path / "in" / "v.png", mosaic(behind(light, angles), MONO))
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(GRAY, calibration=calibration))
    found = summary(tmp_path / "out")
    expected = behind(light).reshape(4, 12, 4, 16, 4, 3).mean(axis=(2, 4)) * found["scale"]
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), expected, atol=0.025)
    assert found["scale"] == pytest.approx(1.0 if calibration.permutes else 2 / (1 + np.sqrt(2)))


def test_given_gains_are_divided_out(tmp_path: Path) -> None:
    light = smooth_light()
    response = np.array([0.9, 1.0, 1.05, 0.8])
    write_mosaic(tmp_path / "in" / "v.png", mosaic(behind(light) * response[:, None, None, None], COLOR))
    calibration = Calibration(gains=(0.9, 1.0, 1.05, 0.8))
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(COLORED, gains="auto", calibration=calibration))
    expected = superpixels(light, COLOR) * 0.8
    np.testing.assert_allclose(read_polar(tmp_path / "out", "v"), expected, atol=4e-5)


def test_views_are_read_in_order_and_provenance_is_kept(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in", 3)
    done = prepare_scene(tmp_path / "in", tmp_path / "out", replace(COLORED, demosaic="half", gains="auto"))
    assert done.views == ["v000", "v001", "v002"]
    found = summary(tmp_path / "out")
    assert (found["format"], found["sensor"], found["pattern"]) == ("mosaic", "IMX250MYR", list(COLOR))
    assert found["clipped_share"] == 0.0
    assert not (tmp_path / "out" / "prepare.json").exists()
    assert read_polar(tmp_path / "out", "v002").shape == (4, 24, 32, 3)


def test_a_monochrome_capture_is_written_as_one_channel(tmp_path: Path) -> None:
    for color, channels in ((False, 1), (True, 3)):
        folder = tmp_path / str(color)
        write_mosaics(folder / "in", 1, color=color)
        prepare_scene(folder / "in", folder / "out", COLORED if color else GRAY)
        data = (folder / "out" / "polar" / "v000_045.png").read_bytes()
        assert data[25] == (0 if channels == 1 else 2)  # IHDR: gray or RGB
        assert np.ptp(read_polar(folder / "out", "v000"), axis=-1).max() == (
            0 if channels == 1 else pytest.approx(0.3, abs=0.2)
        )


SIZE = (64, 96)


def light() -> np.ndarray:
    """Stokes vectors [H, W, 3] that change slowly: a DoLP of 0.1 at all angles."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    s0 = 0.9 + 0.1 * np.sin(x / 60)
    turn = np.pi * x / SIZE[1] + y / 100
    return np.stack([s0, 0.1 * s0 * np.cos(2 * turn), 0.1 * s0 * np.sin(2 * turn)], axis=-1)


def made(folder: Path, name: str) -> tuple[MadeSensor, PrepareSettings]:
    """A sensor with errors at every pixel, a mosaic of it, and its calibration; settings without the latter."""
    sensor = made_sensor(name, SIZE, single=True, seed=5)
    write_codes(folder / "raw" / "v.png", sensor.sees(light()))
    write_analyzers(folder / "camera.safetensors", true_calibration(sensor))
    return sensor, PrepareSettings(sensor=name, poses="none", gains="none", bits=12)


def dolp(scene: Path) -> np.ndarray:
    """DoLP of S0 over the colors, away from the edges, where nothing is interpolated beyond the picture."""
    s0, s1, s2 = stokes_of_four(read_polar(scene, "v").mean(axis=-1))
    return (np.hypot(s1, s2) / s0)[4:-4, 4:-4]


@pytest.mark.parametrize("name", ["IMX250MZR", "IMX250MYR"])
@pytest.mark.parametrize("mode", ["half", "quarter", "full"])
def test_the_error_of_dolp_falls_fivefold_in_the_scene(tmp_path: Path, name: str, mode: str) -> None:
    _, settings = made(tmp_path, name)
    settings = replace(settings, demosaic=mode)
    prepare_scene(tmp_path / "raw", tmp_path / "plain", settings)
    corrected = replace(settings, analyzers=tmp_path / "camera.safetensors", gains="auto")
    prepare_scene(tmp_path / "raw", tmp_path / "corrected", corrected)
    before, after = (np.abs(dolp(tmp_path / scene) - 0.1).mean() for scene in ("plain", "corrected"))
    assert after < before / 5
    said = json.loads((tmp_path / "corrected" / "scene.json").read_text())
    assert (said["analyzers"]["sensor"], len(said["analyzers"]["sha256"])) == (name, 64)
    assert said["gains"] == [1.0, 1.0, 1.0, 1.0]
    assert said["scale"] < 1.0
    assert said["pair_ratio"] == pytest.approx(1.0, abs=0.002)
    assert any("With the calibration" in note for note in said["notes"])
    assert read_polar(tmp_path / "corrected", "v").max() < 1.0


def test_saturated_samples_spoil_their_whole_cell(tmp_path: Path) -> None:
    sensor, settings = made(tmp_path, "IMX250MZR")
    values = sensor.sees(light())
    values[20, 30] = 1.0
    write_codes(tmp_path / "raw" / "v.png", values)
    settings = replace(settings, analyzers=tmp_path / "camera.safetensors", demosaic="full", register=False)
    prepare_scene(tmp_path / "raw", tmp_path / "scene", settings)
    invalid = read_invalid(tmp_path / "scene", "v")
    assert invalid[20:22, 30:32].all()
    assert invalid[22, 32]  # bilinear interpolation uses the neighbors of a sample
    assert not invalid[26:, :].any()


def test_the_same_command_goes_on_and_another_calibration_is_refused(tmp_path: Path) -> None:
    sensor, settings = made(tmp_path, "IMX250MZR")
    settings = replace(settings, analyzers=tmp_path / "camera.safetensors")
    prepare_scene(tmp_path / "raw", tmp_path / "scene", settings)
    assert not prepare_scene(tmp_path / "raw", tmp_path / "scene", settings).new
    write_analyzers(tmp_path / "other.safetensors", replace(true_calibration(sensor), lens="another"))
    Fault(found="file ../camera.safetensors that was removed").raised_by(
        prepare_scene,
        tmp_path / "raw",
        tmp_path / "scene",
        replace(settings, analyzers=tmp_path / "other.safetensors"),
    )


def test_a_scene_of_an_earlier_version_can_be_repeated(tmp_path: Path) -> None:
    _, settings = made(tmp_path, "IMX250MZR")
    prepare_scene(tmp_path / "raw", tmp_path / "scene", settings)
    path = tmp_path / "scene" / "scene.json"
    content = json.loads(path.read_text())
    del content["prepare"]["request"]["settings"]["analyzers"]
    path.write_text(json.dumps(content))
    assert not prepare_scene(tmp_path / "raw", tmp_path / "scene", settings).new


def test_the_calibration_of_another_camera_is_said(tmp_path: Path) -> None:
    sensor, settings = made(tmp_path, "IMX250MZR")
    vectors = true_calibration(sensor).vectors.copy()
    vectors[:, :, [0, 1], [0, 1]] *= 1.03  # one whose 0 and 90 degrees let more light through
    write_analyzers(tmp_path / "other.safetensors", replace(true_calibration(sensor), vectors=vectors))
    heard = Heard()
    asked = replace(settings, analyzers=tmp_path / "other.safetensors")
    prepare_scene(tmp_path / "raw", tmp_path / "scene", asked, heard)
    assert any("of another camera" in text for text in heard.said)


def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    _, settings = made(tmp_path, "IMX250MZR")
    path = tmp_path / "camera.safetensors"
    wanted = replace(settings, analyzers=path)
    cases = {
        "a calibration of the sensor IMX250MYR, found the calibration of IMX250MZR": replace(
            wanted, sensor="IMX250MYR"
        ),
        "found the calibration of 96x64": replace(wanted, offset_x=2),
        "contain the gains of every pixel": replace(wanted, calibration=Calibration(gains=(1, 1, 1, 1.01))),
    }
    for expected, asked in cases.items():
        assert expected in str(Fault().raised_by(prepare_scene, tmp_path / "raw", tmp_path / "scene", asked))
    path.write_bytes(path.read_bytes()[:-50])
    Fault(found="damaged or foreign data").raised_by(
        prepare_scene, tmp_path / "raw", tmp_path / "scene", wanted
    )
    assert not (tmp_path / "scene").exists()


def test_one_option_takes_both_kinds_of_files(tmp_path: Path) -> None:
    made(tmp_path, "IMX250MZR")
    (tmp_path / "angles.json").write_text('{"order": [90, 45, 0, 135]}')
    analyzers = CalibrationOptions(calibration=tmp_path / "camera.safetensors", sense="cw")
    assert analyzers.analyzers() == tmp_path / "camera.safetensors"
    assert analyzers.read() == Calibration(sense="cw")
    angles = CalibrationOptions(calibration=tmp_path / "angles.json")
    assert angles.analyzers() is None
    assert angles.read().order == (90, 45, 0, 135)
