"""``prepare --calibration`` with a file of ``calibrate``: the pictures are those of ideal polarizers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import read_invalid, read_polar
from made_sensor import MadeSensor, made_sensor, true_calibration, write_codes

from polarguide.capture.calibration import Calibration
from polarguide.capture.sensor.analyzer_file import write_analyzers
from polarguide.errors import PolarguideError
from polarguide.polarizer import stokes_of_four
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings
from polarguide.progress import Reporter

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
    assert said["analyzers"]["sensor"] == name
    assert len(said["analyzers"]["sha256"]) == 64
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
    other = true_calibration(sensor)
    write_analyzers(tmp_path / "other.safetensors", replace(other, lens="another"))
    with pytest.raises(PolarguideError, match="that was changed, added or removed"):
        prepare_scene(
            tmp_path / "raw", tmp_path / "scene", replace(settings, analyzers=tmp_path / "other.safetensors")
        )


def test_a_scene_of_an_earlier_version_can_be_repeated(tmp_path: Path) -> None:
    _, settings = made(tmp_path, "IMX250MZR")
    prepare_scene(tmp_path / "raw", tmp_path / "scene", settings)
    path = tmp_path / "scene" / "scene.json"
    content = json.loads(path.read_text())
    del content["prepare"]["request"]["settings"]["analyzers"]
    path.write_text(json.dumps(content))
    assert not prepare_scene(tmp_path / "raw", tmp_path / "scene", settings).new


class Heard(Reporter):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)


def test_the_calibration_of_another_camera_is_said(tmp_path: Path) -> None:
    sensor, settings = made(tmp_path, "IMX250MZR")
    vectors = true_calibration(sensor).vectors.copy()
    vectors[:, :, [0, 1], [0, 1]] *= 1.03  # one whose 0 and 90 degrees let more light through
    other = replace(true_calibration(sensor), vectors=vectors)
    write_analyzers(tmp_path / "other.safetensors", other)
    heard = Heard()
    asked = replace(settings, analyzers=tmp_path / "other.safetensors")
    prepare_scene(tmp_path / "raw", tmp_path / "scene", asked, heard)
    assert any("is it one of another?" in text for text in heard.said)


def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    _, settings = made(tmp_path, "IMX250MZR")
    path = tmp_path / "camera.safetensors"
    wanted = replace(settings, analyzers=path)
    cases = {
        "a calibration of the sensor IMX250MYR, found one of IMX250MZR": replace(wanted, sensor="IMX250MYR"),
        "from column 2, row 0 on, or more, found one of 96x64": replace(wanted, offset_x=2),
        "hold the gains of every pixel": replace(wanted, calibration=Calibration(gains=(1, 1, 1, 1.01))),
    }
    for expected, asked in cases.items():
        with pytest.raises(PolarguideError) as error:
            prepare_scene(tmp_path / "raw", tmp_path / "scene", asked)
        assert expected in str(error.value)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(PolarguideError, match="damaged or foreign data"):
        prepare_scene(tmp_path / "raw", tmp_path / "scene", wanted)
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
