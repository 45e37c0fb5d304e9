"""The noise of a shot: estimated from its own redundancy, and carried through the demosaicing, against drawn noise."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.geometry.polarizer import ANGLES, malus
from polarguide_shots.maps import Reason, interpolation_factors
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot

FULL = 4095


def write_mosaic(
    path: Path,
    sensor: str,
    *,
    degree: float,
    angle: float,
    side: int = 256,
    well: float = 0.0,
    ramp: bool = True,
) -> None:
    """Write a mosaic of one polarization and a brightness ramp, with shot noise of ``well`` electrons."""
    pattern = sensor_pattern(sensor)
    s0 = np.linspace(0.3, 1.1, side) if ramp else np.full(side, 0.7)
    if pattern.colors is not None:
        s0 = s0 * np.array([0.8, 1.1, 0.7])[tiled(pattern.colors, (side, side))]
    stokes = (s0, s0 * degree * math.cos(2 * angle), s0 * degree * math.sin(2 * angle))
    at = np.deg2rad(tiled(pattern.angles, (side, side)))
    clean = malus(stokes, at)
    rng = np.random.default_rng(5)
    noisy = rng.poisson(clean * well) / well if well else clean
    cv2.imwrite(str(path), np.rint(np.clip(noisy, 0, 1) * FULL).astype(np.uint16))


@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_the_electrons_at_full_scale_are_found(tmp_path: Path, sensor: str) -> None:
    write_mosaic(tmp_path / "a.png", sensor, degree=0.3, angle=0.4, well=8000.0, side=512)
    found = read_shot(tmp_path / "a.png", ShotOptions(sensor=sensor, bits=12)).noise
    assert found.source == "estimated"
    for intensity in (0.2, 0.4):
        assert found.floor + found.slope * intensity == pytest.approx(intensity / 8000, rel=0.1)


@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
@pytest.mark.parametrize("mode", ["full", "half", "quarter"])
def test_sigma_of_a_mosaic_is_the_spread_of_its_maps(tmp_path: Path, sensor: str, mode: str) -> None:
    write_mosaic(tmp_path / "a.png", sensor, degree=0.25, angle=0.4, well=5000.0, side=512, ramp=False)
    options = ShotOptions(sensor=sensor, bits=12, demosaic=mode, full_well=5000.0)  # type: ignore[arg-type]
    maps = read_shot(tmp_path / "a.png", options)
    inner = np.s_[16:-16, 16:-16]
    spread = float(np.sqrt(np.mean((maps.dolp_debiased[inner] - 0.25) ** 2)))
    stated = float(np.sqrt(np.mean(maps.sigma_dolp[inner] ** 2)))
    assert stated == pytest.approx(spread, rel=0.08)
    off = np.angle(np.exp(2j * (maps.aolp[inner] - 0.4))) / 2
    assert float(np.sqrt(np.mean(maps.sigma_aolp[inner] ** 2))) == pytest.approx(float(off.std()), rel=0.08)


@pytest.mark.parametrize("colors", [1, 3])
def test_sigma_of_shots_is_the_spread_of_their_maps(tmp_path: Path, colors: int) -> None:
    """Gray files are included. Their three colors are one sample."""
    rng, well = np.random.default_rng(6), 5000.0
    for angle in ANGLES:
        clean = np.full((256, 256, colors), malus((0.7, 0.7 * 0.25, 0.0), math.radians(angle)))
        cv2.imwrite(
            str(tmp_path / f"a_{angle}.png"),
            np.rint(rng.poisson(clean * well) / well * 65535).astype(np.uint16),
        )
    files = [tmp_path / f"a_{angle}.png" for angle in ANGLES]
    maps = read_shot(files, ShotOptions(transfer="linear", align=False, full_well=well))
    assert float(maps.sigma_dolp.mean()) == pytest.approx(float(maps.dolp_debiased.std()), rel=0.05)


def test_interpolated_values_have_less_noise() -> None:
    factors, _ = interpolation_factors("IMX250MZR", 0, 0, "full")
    assert factors.shape == (4, 2, 2)
    # The pixel of 90 degrees has its own sample, means of two to the sides, and of four along the diagonals.
    np.testing.assert_allclose(factors[:, 0, 0], [0.25, 0.5, 1.0, 0.5])
    shifted, _ = interpolation_factors("IMX250MZR", 1, 1, "full")
    np.testing.assert_allclose(shifted[:, 0, 0], [1.0, 0.5, 0.25, 0.5])
    # Four samples of an angle in 4x4 pixels; of the colors one red, two green and one blue.
    np.testing.assert_allclose(interpolation_factors("IMX250MZR", 0, 0, "quarter")[0][:, 0, 0], 1 / 4)
    np.testing.assert_allclose(
        interpolation_factors("IMX250MYR", 0, 0, "quarter")[0][:, 0, 0], 2.5 / 9, rtol=1e-6
    )


def test_noise_pixels_and_dark_ones(tmp_path: Path) -> None:
    """Weak polarization is noise, black is dark, full scale is saturated, each where it is."""
    write_mosaic(tmp_path / "a.png", "IMX250MZR", degree=0.001, angle=0.4, well=3000.0)
    picture = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    picture[:40] = 0
    picture[200:220, 100:120] = FULL
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    maps = read_shot(tmp_path / "a.png", ShotOptions(sensor="IMX250MZR", bits=12, full_well=3000.0))
    assert (maps.reason[:38] == Reason.DARK).all()
    assert (maps.reason[202:218, 102:118] == Reason.SATURATED).all()
    assert np.mean(maps.reason[60:180] == Reason.NOISE) > 0.9
    assert not maps.usable[:38].any()
    assert maps.measured[60:180].all()
    assert (maps.reason[222:, 122:] != Reason.SATURATED).all()


def test_without_noise_the_step_of_the_numbers_is_left(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png", "IMX250MZR", degree=0.3, angle=0.4)
    noise = read_shot(tmp_path / "a.png", ShotOptions(sensor="IMX250MZR", bits=12)).noise
    assert 0 < (noise.floor + noise.slope * 0.3) ** 0.5 < 1 / FULL
