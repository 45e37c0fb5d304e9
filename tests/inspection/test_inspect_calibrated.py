"""``inspect --calibration``: what a scene would be with a calibration, on top of what ``prepare`` did to it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import write_model
from faults import Fault
from made_sensor import made_sensor, true_calibration, write_codes

from polarguide.capture.calibration import Calibration
from polarguide.capture.sensor.analyzers import write_analyzers
from polarguide.geometry.polarizer import ANGLES, stokes_of_four
from polarguide.inspection.capture import read_capture
from polarguide.inspection.corrections import analyzer_check, corrected
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

SIZE = (64, 96)
PLAIN = PrepareSettings(sensor="IMX250MZR", poses="none", gains="none", bits=12)
VARIANTS = {
    "as they are": PLAIN,
    "estimated gains": replace(PLAIN, gains="auto"),
    "quarter size": replace(PLAIN, demosaic="quarter"),
    "other names": replace(PLAIN, calibration=Calibration(order=(90, 45, 0, 135), sense="cw", zero=45.0)),
    "a color sensor": replace(PLAIN, sensor="IMX250MYR"),
}


def scene(folder: Path, settings: PrepareSettings) -> Path:
    """Two views of light with a DoLP of 0.1 behind a sensor with errors; ``camera.safetensors`` beside the scene."""
    assert settings.sensor is not None
    sensor = made_sensor(settings.sensor, SIZE, seed=2)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    turn = np.pi * x / SIZE[1] + y / 90
    stokes = 0.8 * np.stack([np.ones(SIZE), 0.1 * np.cos(2 * turn), 0.1 * np.sin(2 * turn)], axis=-1)
    for index in range(2):
        write_codes(folder / "raw" / f"v{index}.png", (1 - 0.1 * index) * sensor.sees(stokes))
    write_analyzers(folder / "camera.safetensors", true_calibration(sensor))
    return prepare_scene(folder / "raw", folder / "scene", settings).folder


def error_of_dolp(root: Path, calibration: Path | None, downscale: int = 1) -> float:
    capture = read_capture(root, downscale=downscale)
    if calibration is not None:
        capture = corrected(capture, calibration)
    s0, s1, s2 = stokes_of_four(capture.views[1].intensities().numpy().mean(axis=-1))
    return float(np.abs(np.hypot(s1, s2) / s0 - 0.1)[3:-3, 3:-3].mean())


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("downscale", [1, 2])
def test_the_error_of_dolp_falls_fivefold(tmp_path: Path, variant: str, downscale: int) -> None:
    root = scene(tmp_path, VARIANTS[variant])
    before = error_of_dolp(root, None, downscale)
    after = error_of_dolp(root, tmp_path / "camera.safetensors", downscale)
    # Averages over the colors or boxes of a picture have less of an error to begin with.
    assert after < before / (5 if variant != "a color sensor" else 3)


def test_matrices_follow_the_removal_of_distortion(tmp_path: Path) -> None:
    model = write_model(tmp_path / "model", ("v0", "v1"), "SIMPLE_RADIAL 96 64 100 48 32 0.1")
    root = scene(tmp_path, replace(PLAIN, poses=str(model)))
    assert error_of_dolp(root, tmp_path / "camera.safetensors") < error_of_dolp(root, None) / 5


def test_pictures_of_another_program_are_taken_for_cells(tmp_path: Path) -> None:
    root = scene(tmp_path, PLAIN)
    for view in ("v0", "v1"):
        for angle in ANGLES:
            picture = cv2.imread(str(root / "polar" / f"{view}_{angle:03d}.png"), cv2.IMREAD_UNCHANGED)
            (tmp_path / "other" / "polar").mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(tmp_path / "other" / "polar" / f"{view}_{angle:03d}.png"), picture)
    found = error_of_dolp(tmp_path / "other", tmp_path / "camera.safetensors")
    assert found == error_of_dolp(root, tmp_path / "camera.safetensors")


def test_the_check_says_what_was_used(tmp_path: Path) -> None:
    root = scene(tmp_path, PLAIN)
    path = tmp_path / "camera.safetensors"
    capture = read_capture(root)
    assert analyzer_check(capture, None) is None
    check = analyzer_check(capture, path)
    assert check is not None
    assert "IMX250MZR" in check.finding
    assert "prepare its mosaics with --calibration" in check.remedy
    prepared = prepare_scene(tmp_path / "raw", tmp_path / "calibrated", replace(PLAIN, analyzers=path)).folder
    check = analyzer_check(read_capture(prepared), None)
    assert check is not None
    assert check.finding.startswith("Prepared with the calibration of IMX250MZR")
    Fault(expected="a scene that was prepared without --calibration").raised_by(
        corrected, read_capture(prepared), path
    )


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    root = scene(tmp_path / "gray", PLAIN)
    other = true_calibration(made_sensor("IMX250MYR", SIZE))
    write_analyzers(tmp_path / "color.safetensors", other)
    Fault(expected="a calibration of the sensor IMX250MZR", found="the calibration of IMX250MYR").raised_by(
        corrected, read_capture(root), tmp_path / "color.safetensors"
    )
    small = true_calibration(made_sensor("IMX250MZR", (32, 48)))
    write_analyzers(tmp_path / "small.safetensors", small)
    Fault(expected="a calibration that covers 96x64 pixels", found="the calibration of 48x32").raised_by(
        corrected, read_capture(root), tmp_path / "small.safetensors"
    )
    turned = scene(tmp_path / "turned", replace(PLAIN, calibration=Calibration(zero=10.0)))
    Fault(found="a scene with another zero").raised_by(
        corrected, read_capture(turned), tmp_path / "turned" / "camera.safetensors"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"geometry": {"step": 0}}, "a step of 0"),
        ({"geometry": {"size": [2, 2]}}, "a size that differs"),
        ({"warp": {"model": "NOPE", "parameters": []}}, 'a camera "NOPE"'),
        ({"warp": {"model": "PINHOLE", "parameters": [1.0]}}, "with 1 parameters"),
    ],
)
def test_a_record_of_prepare_that_was_changed_is_named(tmp_path: Path, change: dict, words: str) -> None:
    root = scene(tmp_path, PLAIN)
    record = json.loads((root / "scene.json").read_text())
    for view in record["prepare"]["views"].values():
        for key, values in change.items():
            view[key] = {**(view[key] or {}), **values}
    (root / "scene.json").write_text(json.dumps(record))
    Fault("scene.json", found=words).raised_by(corrected, read_capture(root), tmp_path / "camera.safetensors")


def test_gains_that_are_none_are_refused(tmp_path: Path) -> None:
    root = scene(tmp_path, PLAIN)
    record = json.loads((root / "scene.json").read_text())
    (root / "scene.json").write_text(json.dumps({**record, "gains": [0, 1, 1, 1]}))
    Fault("scene.json").raised_by(corrected, read_capture(root), tmp_path / "camera.safetensors")


def test_a_rendered_scene_says_its_sensor_in_other_words(tmp_path: Path) -> None:
    """As ``synth --sensor`` does, whose pictures are not those of the mosaics beside them."""
    root = scene(tmp_path, PLAIN)
    about = {"sensor": {"name": "IMX250MZR", "gains": [1.0, 1.0, 1.0, 1.0]}}
    (root / "scene.json").write_text(json.dumps(about))
    capture = read_capture(root)
    assert analyzer_check(capture, None) is None
    Fault(found="or rendered").raised_by(corrected, capture, tmp_path / "camera.safetensors")
