"""Single shots with a file of ``calibrate``: the maps are those of ideal polarizers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import Fault
from heard import Heard
from made_sensor import made_sensor, true_calibration, write_codes

from polarguide.capture.sensor.analyzers import write_analyzers
from polarguide_shots.measurement.line import measure_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from polarguide_shots.write import write_shots

SIZE = (64, 96)


def _light() -> np.ndarray:
    """Stokes vectors [H, W, 3]: a DoLP of 0.1 at all angles."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    turn = np.pi * x / SIZE[1] + y / 100
    s0 = 0.9 + 0.1 * np.sin(x / 60)
    return np.stack([s0, 0.1 * s0 * np.cos(2 * turn), 0.1 * s0 * np.sin(2 * turn)], axis=-1)


def _made(folder: Path, name: str) -> ShotOptions:
    sensor = made_sensor(name, SIZE, single=True, seed=5)
    write_codes(folder / "v.png", sensor.sees(_light()))
    write_analyzers(folder / "camera.safetensors", true_calibration(sensor))
    return ShotOptions(sensor=name, bits=12)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["IMX250MZR", "IMX250MYR"])
@pytest.mark.parametrize("mode", ["half", "full"])
def test_the_error_of_dolp_falls_fivefold(tmp_path: Path, name: str, mode: str) -> None:
    options = replace(_made(tmp_path, name), demosaic=mode)
    corrected = replace(options, analyzers=tmp_path / "camera.safetensors", gains="auto")
    before, after = (
        np.abs(read_shot(tmp_path / "v.png", o).dolp[4:-4, 4:-4] - 0.1).mean() for o in (options, corrected)
    )
    assert after < before / 5
    maps = read_shot(tmp_path / "v.png", corrected)
    assert maps.pair_ratio == pytest.approx(1.0, abs=0.002)
    assert any("With the calibration" in note for note in maps.notes)


def test_what_it_does_not_fit_is_refused(tmp_path: Path) -> None:
    options = replace(_made(tmp_path, "IMX250MZR"), analyzers=tmp_path / "camera.safetensors")
    Fault(expected="a calibration of the sensor IMX250MYR").raised_by(
        read_shot, tmp_path / "v.png", replace(options, sensor="IMX250MYR")
    )
    Fault(expected="a calibration that covers").raised_by(
        read_shot, tmp_path / "v.png", replace(options, offset_x=2)
    )
    for angle in (0, 45, 90, 135):
        write_codes(tmp_path / f"w_{angle:03d}.png", np.full(SIZE, 0.5))
    shots = [tmp_path / f"w_{angle:03d}.png" for angle in (0, 45, 90, 135)]
    Fault("--calibration", found="a shot through a filter").raised_by(
        read_shot, shots, ShotOptions(analyzers=options.analyzers)
    )
    (tmp_path / "camera.safetensors").unlink()
    Fault("camera.safetensors)", expected="a file").raised_by(read_shot, tmp_path / "v.png", options)


def test_a_calibration_that_fits_no_shot_is_told_once(tmp_path: Path) -> None:
    options = replace(_made(tmp_path, "IMX250MZR"), analyzers=tmp_path / "camera.safetensors")
    heard = Heard()
    for wrong in (replace(options, sensor="IMX250MYR"), replace(options, analyzers=tmp_path / "none")):
        fault = Fault(str(wrong.analyzers))
        fault.raised_by(write_shots, [tmp_path], tmp_path / "out", wrong, formats=("npy",), reporter=heard)
        fault.raised_by(measure_shots, [tmp_path], tmp_path / "table", reading=wrong)
    assert heard.said == []
    assert not (tmp_path / "table").exists()
