"""Simulated sensors, put back together by what reads real ones."""

from __future__ import annotations

import numpy as np
import pytest

from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.synth.sensor import Sensor, mosaic, noisy

IDEAL = Sensor(extinction=1e9, gains=(1, 1, 1, 1))


def even(s0: float, s1: float, s2: float, size: int = 64) -> np.ndarray:
    return np.tile(np.array([s0, s1, s2])[:, None, None, None], (1, size, size, 3))


def samples(raw: np.ndarray, name: str, angle: int) -> np.ndarray:
    pattern = sensor_pattern(name)
    repeat = [side // pattern.period for side in raw.shape]
    return raw[np.tile(pattern.angles, repeat) == angle].astype(float)


@pytest.mark.parametrize("name", ["IMX250MYR", "IMX250MZR"])
def test_an_ideal_sensor_stores_maluss_law(name: str) -> None:
    raw = mosaic(even(0.8, 0.3, -0.2), name, 0, np.random.default_rng(0), IDEAL)
    assert raw.dtype == np.uint16
    for angle, expected in ((0, 0.55), (45, 0.3), (90, 0.25), (135, 0.5)):
        value = (samples(raw, name, angle) - 64) / (4095 - 64)
        np.testing.assert_allclose(value, expected, atol=2e-4)


def test_faults_have_their_sizes() -> None:
    sensor = Sensor(extinction=99.0, gains=(1.0, 0.9, 1.1, 1.0))
    raw = mosaic(even(0.5, 0.5, 0.0), "IMX250MZR", 0, np.random.default_rng(0), sensor)
    value = {a: (samples(raw, "IMX250MZR", a).mean() - 64) / (4095 - 64) for a in (0, 45, 90, 135)}
    assert value[0] == pytest.approx(0.495, abs=1e-3)
    assert value[90] == pytest.approx(1.1 * 0.005, abs=1e-3)
    assert value[45] / value[135] == pytest.approx(0.9, abs=1e-3)


def test_noise_is_that_of_photons_and_reading() -> None:
    sensor = Sensor()
    for noise in (1.0, 4.0):
        found = noisy(np.full(200000, 0.3), noise, np.random.default_rng(1), sensor)
        electrons = sensor.full_well / noise**2
        expected = np.sqrt(0.3 * electrons + sensor.read_noise**2) / electrons
        assert found.mean() == pytest.approx(0.3, abs=4 * expected / np.sqrt(200000))
        assert found.std() == pytest.approx(expected, rel=0.02)
    assert (noisy(np.full(3, 0.3), 0, np.random.default_rng(1), sensor) == 0.3).all()


def test_values_stop_at_full_scale_and_at_zero() -> None:
    raw = mosaic(even(5.0, 0, 0, 8), "IMX250MYR", 1, np.random.default_rng(0), Sensor())
    assert (raw == 4095).all()
    dark = mosaic(even(0, 0, 0), "IMX250MYR", 1, np.random.default_rng(0), Sensor())
    assert dark.mean() == pytest.approx(64, abs=0.2)
