"""Analyzer vectors of a sensor: the correction, on mosaics and on four intensities, and their file."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from faults import Fault
from made_sensor import COLORS, MadeSensor, made_sensor, true_calibration

from polarguide.capture.sensor.analyzers import (
    AnalyzerCalibration,
    correction_matrices,
    read_analyzers,
    spread_to_cells,
    write_analyzers,
)
from polarguide.capture.sensor.pattern import sensor_pattern, tiled

SENSORS = ("IMX250MZR", "IMX250MYR")
LIGHT = np.array([0.8, 0.05, -0.06])


def ideal_mosaic(sensor: MadeSensor, stokes: np.ndarray) -> np.ndarray:
    """What ideal polarizers behind the same color filters see."""
    s0, s1, s2 = np.moveaxis(np.broadcast_to(stokes, sensor.vectors.shape), -1, 0)
    seen = (s0 + s1 * np.cos(2 * sensor.nominal) + s2 * np.sin(2 * sensor.nominal)) / 2
    colors = sensor_pattern(sensor.name).colors
    return seen if colors is None else seen * tiled(COLORS[colors], seen.shape)


@pytest.mark.parametrize("name", SENSORS)
def test_the_correction_gives_what_ideal_polarizers_would_measure(name: str) -> None:
    sensor = made_sensor(name, (24, 32), single=True)
    found = true_calibration(sensor).apply(sensor.sees(LIGHT).astype(np.float32))
    np.testing.assert_allclose(found, ideal_mosaic(sensor, LIGHT), atol=2e-6)


@pytest.mark.parametrize("name", SENSORS)
def test_the_samples_of_an_ideal_sensor_do_not_change_whatever_they_are(name: str) -> None:
    turn = np.radians(sensor_pattern(name).angles)
    vectors = np.stack([np.ones_like(turn), np.cos(2 * turn), np.sin(2 * turn)], axis=-1)[None, None] / 2
    ideal = AnalyzerCalibration(name, "", (0, 0), (32, 24), 32, vectors.astype(np.float32), "mean")
    noise = np.random.default_rng(0).uniform(0, 1, (24, 32)).astype(np.float32)
    np.testing.assert_allclose(ideal.apply(noise), noise, atol=1e-6)


def test_the_part_that_no_light_explains_is_kept_at_its_size() -> None:
    turn = np.radians([90.0, 45.0, 135.0, 0.0]) + np.random.default_rng(1).uniform(-0.03, 0.03, 4)
    a = np.stack([np.ones(4), 0.9 * np.cos(2 * turn), 0.9 * np.sin(2 * turn)], axis=1) / 2
    matrix = correction_matrices([row.astype(np.float32) for row in a], np.array([90, 45, 135, 0]))
    turn = np.radians([90.0, 45.0, 135.0, 0.0])
    ideal = np.stack([np.ones(4), np.cos(2 * turn), np.sin(2 * turn)], axis=1) / 2
    np.testing.assert_allclose(matrix @ a, ideal, atol=1e-6)
    np.testing.assert_allclose(np.linalg.pinv(ideal) @ matrix, np.linalg.pinv(a), atol=1e-5)
    np.testing.assert_allclose(np.abs(matrix @ np.linalg.svd(a)[0][:, 3]), 0.5, atol=1e-5)


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("offset", [(2, 4), (1, 0), (3, 1)])
def test_a_region_of_the_calibration_is_enough(name: str, offset: tuple[int, int]) -> None:
    sensor = made_sensor(name, (32, 40), single=True)
    whole = true_calibration(sensor)
    x, y = offset
    seen = sensor.sees(LIGHT).astype(np.float32)[y : y + 24, x : x + 32]
    expected = ideal_mosaic(sensor, LIGHT)[y : y + 24, x : x + 32]
    left, top = whole.pattern.shifted(*offset).cell_corner()
    found = whole.apply(seen, offset=offset)
    end_y, end_x = top + (24 - top) // 2 * 2, left + (32 - left) // 2 * 2
    np.testing.assert_allclose(found[top:end_y, left:end_x], expected[top:end_y, left:end_x], atol=2e-6)
    if left:  # a column that fills no cell stays as it was
        np.testing.assert_array_equal(found[:, 0], seen[:, 0])


def test_the_peak_bounds_what_comes_out() -> None:
    calibration = true_calibration(made_sensor("IMX250MZR", (24, 32), single=True))
    samples = np.random.default_rng(0).integers(0, 2, (24, 32)).astype(np.float32)
    peak = calibration.peak((0, 0), (32, 24))
    assert 1.0 < peak < 1.4
    assert calibration.apply(samples).max() <= peak + 1e-6


def test_bad_samples_spread_to_their_cells() -> None:
    bad = np.zeros((4, 6), bool)
    bad[1, 2] = True
    expected = np.zeros((4, 6), bool)
    expected[:2, 2:4] = True
    np.testing.assert_array_equal(spread_to_cells(bad), expected)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    sensor = made_sensor("IMX250MZR", (24, 32))
    write_analyzers(tmp_path / "camera.safetensors", true_calibration(sensor))
    return tmp_path / "camera.safetensors"


def test_the_file_gives_back_what_was_written_and_is_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    found = read_analyzers(saved)
    written = true_calibration(made_sensor("IMX250MZR", (24, 32)))
    np.testing.assert_array_equal(found.vectors, written.vectors)
    assert (found.sensor, found.size, found.offset, found.block) == ("IMX250MZR", (32, 24), (0, 0), 2)
    assert write_analyzers(tmp_path / "again.safetensors", found) == found.sha256
    assert (tmp_path / "again.safetensors").read_bytes() == saved.read_bytes()


def header(data: bytes) -> tuple[dict, bytes]:
    length = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def with_header(content: dict, body: bytes) -> bytes:
    text = json.dumps(content).encode()
    return struct.pack("<Q", len(text)) + text + body


def changed_metadata(data: bytes, **changes: object) -> bytes:
    content, body = header(data)
    said = json.loads(content["__metadata__"]["polarguide"])
    content["__metadata__"]["polarguide"] = json.dumps({**said, **changes})
    return with_header(content, body)


def flipped(data: bytes) -> bytes:
    return data[:-3] + bytes([data[-3] ^ 1]) + data[-2:]


DAMAGE = {
    "truncated": (lambda data: data[:-100], "damaged or foreign data"),
    "cut in the header": (lambda data: data[:40], "damaged or foreign data"),
    "empty": (lambda data: b"", "damaged or foreign data"),
    "a bit flipped": (flipped, "other content"),
    "another sensor written over": (lambda data: changed_metadata(data, sensor="IMX264MYR"), "other content"),
    "another version": (lambda data: changed_metadata(data, version=2), "version 2"),
    "an unknown field": (lambda data: changed_metadata(data, date="today"), "found date"),
    "without metadata": (lambda data: with_header({"vectors": header(data)[0]["vectors"]}, header(data)[1]),
                         "another safetensors file"),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGE)
def test_a_file_that_is_damaged_is_refused_with_one_line(saved: Path, how: str) -> None:
    spoil, expected = DAMAGE[how]
    saved.write_bytes(spoil(saved.read_bytes()))
    error = Fault(str(saved)).raised_by(read_analyzers, saved)
    assert expected in str(error)


def test_other_sizes_and_sensors_are_refused(saved: Path) -> None:
    calibration = read_analyzers(saved)
    Fault(expected="a calibration that covers 64x48 pixels", found="the calibration of 32x24").raised_by(
        calibration.apply, np.zeros((48, 64), np.float32)
    )
    Fault(expected="column 20").raised_by(calibration.apply, np.zeros((24, 16), np.float32), offset=(20, 0))
    Fault(expected="a calibration of the sensor IMX250MYR", found="the calibration of IMX250MZR").raised_by(
        calibration.require_sensor, "IMX250MYR", saved
    )
