"""Simulate a polarization camera: raw mosaics with noise, gains and finite extinction.

Full well, read noise and extinction ratio are close to those of Sony's IMX250MYR; photon noise is Poisson distributed,
read noise normal (EMVA 1288).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.polarizer import malus
from polarguide.synth.mesh import Array


@dataclass(frozen=True)
class Sensor:
    """Parameters of a sensor.

    Attributes:
        full_well: electrons at full scale.
        read_noise: standard deviation of the read noise in electrons.
        extinction: extinction ratio of the polarizers.
        gains: of the samples behind polarizers at 0, 45, 90 and 135 degrees.
        bits: bits of a stored value.
        black: black level in stored values.
    """

    full_well: float = 10500.0
    read_noise: float = 2.4
    extinction: float = 300.0
    gains: tuple[float, float, float, float] = (1.0, 0.985, 1.01, 0.992)
    bits: int = 12
    black: int = 64

    def data(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def noisy(intensity: Array, noise: float, random: np.random.Generator, sensor: Sensor) -> Array:
    """Intensities with photon and read noise.

    Args:
        intensity: linear, 1 is full scale.
        noise: 1 for exposure to the full well, 2 for a quarter of that light, 0 for no noise.
        random: generator.
        sensor: its full well and read noise.
    """
    if noise <= 0:
        return intensity
    electrons = sensor.full_well / noise**2
    counts = random.poisson(np.clip(intensity, 0, None) * electrons) + random.normal(
        0, sensor.read_noise, intensity.shape
    )
    return np.asarray(counts / electrons)


def mosaic(
    stokes: Array, name: str, noise: float, random: np.random.Generator, sensor: Sensor
) -> NDArray[np.uint16]:
    """The raw mosaic that a sensor stores, [H, W], given Stokes vectors [3, H, W, 3] whose full scale is 1.

    An extinction ratio E scales S1 and S2 by (E - 1) / (E + 1). A monochrome sensor measures the mean of the colors.
    """
    pattern = sensor_pattern(name)
    angles = tiled(pattern.angles, stokes.shape[1:3])
    if pattern.colors is None:
        light = stokes.mean(-1)
    else:
        colors = tiled(pattern.colors, stokes.shape[1:3])
        light = np.take_along_axis(stokes, colors[None, ..., None], -1)[..., 0]
    contrast = (sensor.extinction - 1) / (sensor.extinction + 1)
    value = malus((light[0], contrast * light[1], contrast * light[2]), np.radians(angles))
    value = noisy(value, noise, random, sensor) * np.array(sensor.gains)[angles // 45]
    top = (1 << sensor.bits) - 1
    return np.clip(np.round(sensor.black + value * (top - sensor.black)), 0, top).astype(np.uint16)
