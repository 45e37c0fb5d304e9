"""Measure the seconds per mosaic of ``pg.measure`` for a sensor of five megapixels, and print a table.

    taskset -c 0 env OMP_NUM_THREADS=1 python benchmarks/speed/measuring.py > benchmarks/records/measuring.md

Run it without other work on the machine. Mosaics are in memory, as frames of a camera. Each cell has the median for a
monochrome sensor and for a color sensor.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import polarguide as pg
from polarguide.capture.sensor.pattern import sensor_pattern, tiled

WIDTH = 2448
HEIGHT = 2048
FRAMES = 7
SKIPPED = 2
"""First frames, which include the setup."""
REGION = (774, 646)
"""Width and height of a tenth of the picture."""


def mosaic(sensor: str) -> NDArray[np.uint16]:
    """Return a noisy mosaic of 12 bits, of polarized light that is darker in blue."""
    pattern = sensor_pattern(sensor)
    light = np.linspace(600, 3000, WIDTH) * np.ones((HEIGHT, 1))
    light *= 1 + 0.1 * np.cos(2 * np.radians(tiled(pattern.angles, light.shape)))
    if pattern.colors is not None:
        light *= np.array([0.8, 1.0, 0.5])[tiled(pattern.colors, light.shape)]
    return np.random.default_rng(0).poisson(light).astype(np.uint16)


def seconds(sensor: str, demosaic: str, region: str | None) -> float:
    """Return the median time of a frame."""
    frame = mosaic(sensor)
    starts = []

    def frames() -> Iterator[NDArray[np.uint16]]:
        for _ in range(SKIPPED + FRAMES):
            starts.append(time.perf_counter())
            yield frame

    options = pg.MeasureOptions(roi=() if region is None else (region,))
    reading = pg.ShotOptions(sensor=sensor, bits=12, demosaic=demosaic)
    outcome = pg.measure(frames(), options=options, reading=reading)
    if "unread" in outcome.counts:
        raise SystemExit(outcome.entries[0].why)
    starts.append(time.perf_counter())
    return statistics.median(np.diff(starts)[SKIPPED:].tolist())


def main() -> None:
    print("| `--demosaic` | whole picture | region of a tenth |\n|---|---|---|")
    for demosaic, scale in (("full", 1), ("half", 2), ("quarter", 4)):
        width, height = (side // scale for side in REGION)
        region = f"part={WIDTH // scale // 4},{HEIGHT // scale // 4},{width},{height}"
        cells = []
        for part in (None, region):
            both = [seconds(sensor, demosaic, part) for sensor in ("IMX250MZR", "IMX250MYR")]
            cells.append(", ".join(f"{value:.2f}" for value in both))
        print(f"| `{demosaic}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
