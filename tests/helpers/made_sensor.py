"""A polarization sensor with made errors, and the shots with which it is calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.capture.sensor.pattern import sensor_pattern, tiled

FULL = 4095
COLORS = np.array([0.6, 1.0, 0.75])
"""What passes the color filters of a white light."""


@dataclass(frozen=True, eq=False)
class MadeSensor:
    """Analyzer vectors [H, W, 3] of a sensor, scaled so that an ideal one has (1, cos 2p, sin 2p) / 2."""

    name: str
    vectors: np.ndarray
    nominal: np.ndarray

    def sees(self, stokes: np.ndarray) -> np.ndarray:
        """Mosaic [H, W] of light: one Stokes vector [3], or one a pixel [H, W, 3]."""
        return (self.vectors * stokes).sum(axis=-1)


def made_sensor(
    name: str = "IMX250MZR",
    size: tuple[int, int] = (96, 128),
    *,
    seed: int = 0,
    single: bool = False,
    offset: tuple[int, int] = (0, 0),
) -> MadeSensor:
    """A sensor whose polarizers have extinction ratios of 20 to 300, lie up to 2 degrees off, and gains of +-3 %.

    Args:
        size: height and width. single: whether every pixel has errors of its own; else every place of the pattern has,
            and they change over the sensor by a quarter of their range. offset: column and row of its corner.
    """
    rng = np.random.default_rng(seed)
    pattern = sensor_pattern(name).shifted(*offset)
    nominal = np.radians(tiled(pattern.angles, size))

    def errors() -> np.ndarray:
        """[H, W] in [-1, 1]."""
        if single:
            return rng.uniform(-1, 1, size)
        y, x = np.mgrid[: size[0], : size[1]] / max(size)
        places = tiled(rng.uniform(-0.75, 0.75, pattern.angles.shape), size)
        return np.asarray(
            places + 0.25 * np.sin(3 * x + rng.uniform(0, 6)) * np.cos(2 * y + rng.uniform(0, 6))
        )

    ratio = np.exp(np.log(20) + (errors() + 1) / 2 * np.log(15))
    angle = nominal + np.radians(2.0) * errors()
    gain = 1 + 0.03 * errors()
    strength = (ratio - 1) / (ratio + 1)
    vectors = np.stack([np.ones(size), strength * np.cos(2 * angle), strength * np.sin(2 * angle)], axis=-1)
    if pattern.colors is not None:
        gain = gain * tiled(COLORS[pattern.colors], size)
    return MadeSensor(name, vectors * gain[..., None] / 2, nominal)


def true_calibration(sensor: MadeSensor, offset: tuple[int, int] = (0, 0)) -> AnalyzerCalibration:
    """The calibration that holds the sensor's own vectors, one a pixel."""
    pattern = sensor_pattern(sensor.name)
    period = pattern.period
    height, width, _ = sensor.vectors.shape
    color = np.ones((height, width))
    if pattern.colors is not None:
        color = tiled(COLORS[pattern.shifted(*offset).colors], (height, width))
    rows, columns = (
        (length + start - 1) // period - start // period + 1
        for length, start in ((height, offset[1]), (width, offset[0]))
    )
    vectors = np.full((rows, columns, period, period, 3), [0.5, 0.5, 0.0], np.float32)
    for y in range(height):
        for x in range(width):
            v, u = y + offset[1], x + offset[0]
            place = (
                v // period - offset[1] // period,
                u // period - offset[0] // period,
                v % period,
                u % period,
            )
            vectors[place] = sensor.vectors[y, x] / color[y, x]
    return AnalyzerCalibration(sensor.name, "", offset, (width, height), period, vectors, "mean")


def polarizer_light(degrees: float, level: float = 1.0, extinction: float = np.inf) -> np.ndarray:
    """Stokes vector [3] behind a polarizer."""
    strength = 1.0 if np.isinf(extinction) else (extinction - 1) / (extinction + 1)
    turn = 2 * np.radians(degrees)
    return level * np.array([1.0, strength * np.cos(turn), strength * np.sin(turn)])


def fall_off(size: tuple[int, int], least: float = 0.95) -> np.ndarray:
    """What a lens does to a uniform light, [H, W]: 1 in the middle, ``least`` in the corners."""
    y, x = (np.linspace(-1, 1, length) for length in size)
    return 1 - (1 - least) * (y[:, None] ** 2 + x**2) / 2


def write_codes(
    path: Path,
    values: np.ndarray,
    *,
    black: float = 0.0,
    electrons: float = 0.0,
    rng: np.random.Generator | None = None,
) -> None:
    """A 12-bit mosaic; ``electrons`` at full scale for shot noise, 0 for none."""
    if electrons:
        assert rng is not None
        values = rng.poisson(np.clip(values, 0, None) * electrons) / electrons
    codes = np.rint(np.clip(values * (FULL - black) + black, 0, FULL)).astype(np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), codes)


def write_polarizer_shots(
    folder: Path,
    sensor: MadeSensor,
    degrees: list[float],
    *,
    level: float = 0.7,
    levels: list[float] | None = None,
    frames: int = 1,
    electrons: float = 0.0,
    black: float = 0.0,
    extinction: float = np.inf,
    seed: int = 1,
) -> None:
    """``shots/shot_<number>_<degrees>.png``, ``flat.png`` and, with a black level, ``dark.png`` in a folder."""
    rng = np.random.default_rng(seed)
    shade = fall_off(sensor.nominal.shape)
    count = 0
    for index, angle in enumerate(degrees):
        light = polarizer_light(angle, level * (levels[index] if levels else 1.0), extinction)
        for _ in range(frames):
            path = folder / "shots" / f"shot_{count:03d}_{angle:g}.png"
            write_codes(path, shade * sensor.sees(light), black=black, electrons=electrons, rng=rng)
            count += 1
    flat = shade * sensor.sees(np.array([1.4 * level, 0.0, 0.0]))
    write_codes(folder / "flat.png", flat, black=black, electrons=electrons, rng=rng)
    if black:
        write_codes(folder / "dark.png", np.zeros(sensor.nominal.shape), black=black)


def dolp_aolp(sensor: MadeSensor, mosaic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """DoLP and AoLP (radians) of the cells of a mosaic that starts with a cell, as ideal analyzers would have it."""
    places = {round(np.degrees(sensor.nominal[y, x])): (y, x) for y in range(2) for x in range(2)}
    i0, i45, i90, i135 = (mosaic[places[a][0] :: 2, places[a][1] :: 2] for a in (0, 45, 90, 135))
    s0, s1, s2 = (i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135
    return np.hypot(s1, s2) / s0, np.arctan2(s2, s1) / 2
