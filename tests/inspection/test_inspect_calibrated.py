"""Report of the sensor calibration with which a scene was prepared."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_sensor import made_sensor, true_calibration, write_codes

from polarguide.capture.sensor.analyzers import write_analyzers
from polarguide.inspection.capture import read_capture
from polarguide.inspection.picture_checks import analyzer_check
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

SIZE = (64, 96)
PLAIN = PrepareSettings(sensor="IMX250MZR", poses="none", gains="none", bits=12)


def test_the_check_says_what_was_used(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", SIZE, seed=2)
    stokes = 0.8 * np.stack([np.ones(SIZE), 0.1 * np.ones(SIZE), np.zeros(SIZE)], axis=-1)
    for index in range(2):
        write_codes(tmp_path / "raw" / f"v{index}.png", (1 - 0.1 * index) * sensor.sees(stokes))
    path = tmp_path / "camera.safetensors"
    write_analyzers(path, true_calibration(sensor))
    plain = prepare_scene(tmp_path / "raw", tmp_path / "plain", PLAIN).folder
    assert analyzer_check(read_capture(plain)) is None
    settings = replace(PLAIN, analyzers=path)
    calibrated = prepare_scene(tmp_path / "raw", tmp_path / "calibrated", settings).folder
    check = analyzer_check(read_capture(calibrated))
    assert check is not None
    assert check.finding.startswith("Prepared with the calibration of IMX250MZR")
