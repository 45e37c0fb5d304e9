"""Measure the gain from aligning the four angles of a cell, on half-size pictures against the ground truth.

The pictures of a capture stand for the light at every pixel and angle. They are mosaicked with shot noise, developed at
half size, and compared with the means over the cells. Errors are means over views: of the DoLP on pixels with S0 above
0.1, and of the AoLP in degrees on pixels whose true DoLP is also above 0.1.

    python benchmarks/accuracy/half_size.py CAPTURE... [--every 12] > benchmarks/records/half-size.md

Prints a Markdown table, with a value of each capture in a cell.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from simulated_mosaics import linear_intensities

from polarguide.capture.layout import find_layout
from polarguide.capture.sensor.demosaic import demosaic
from polarguide.capture.sensor.pattern import Pattern, sensor_pattern
from polarguide.capture.view import ANGLES

SENSORS = {"IMX250MYR": "color", "IMX250MZR": "monochrome"}
ELECTRONS = 10_000
BORDER = 4


def seen(intensities: NDArray[np.float64], pattern: Pattern, rng: np.random.Generator) -> NDArray[np.float32]:
    """Sample one value per pixel of [4, H, W, 3], with shot noise."""
    out = np.empty(intensities.shape[1:3])
    period = pattern.period
    for row, column in np.ndindex(period, period):
        channel = 1 if pattern.colors is None else int(pattern.colors[row, column])
        angle = ANGLES.index(int(pattern.angles[row, column]))
        out[row::period, column::period] = intensities[angle, row::period, column::period, channel]
    return (rng.poisson(out * ELECTRONS) / ELECTRONS).astype(np.float32)


def errors(found: NDArray[np.floating], true: NDArray[np.floating]) -> tuple[float, float]:
    """Return the errors of DoLP, and of AoLP in degrees."""
    inside = np.s_[:, BORDER:-BORDER, BORDER:-BORDER]
    (i0, i45, i90, i135), (t0, t45, t90, t135) = (side[inside].mean(axis=3) for side in (found, true))
    s0, ground_truth = (i0 + i45 + i90 + i135) / 2, (t0 + t45 + t90 + t135) / 2
    lit = ground_truth > 0.1
    dolp, true_dolp = (
        np.hypot(a, b) / np.maximum(s, 1e-4)
        for a, b, s in ((i0 - i90, i45 - i135, s0), (t0 - t90, t45 - t135, ground_truth))
    )
    turn = (np.arctan2(i45 - i135, i0 - i90) - np.arctan2(t45 - t135, t0 - t90)) / 2
    off = np.degrees(np.arcsin(np.abs(np.sin(turn))))
    return (
        float(np.abs(dolp - true_dolp)[lit].mean()),
        float(off[lit & (true_dolp > 0.1)].mean()),
    )


def measured(capture: Path, every: int) -> dict[tuple[str, bool], tuple[float, float]]:
    """Return the mean errors of a capture by sensor, without and with the alignment."""
    layout = find_layout(capture)
    rng = np.random.default_rng(0)
    found: dict[tuple[str, bool], list[tuple[float, float]]] = {}
    for view in layout.names[::every]:
        light = linear_intensities(layout, view, "linear")
        _, height, width, _ = light.shape
        true = light.reshape(4, height // 2, 2, width // 2, 2, 3).mean(axis=(2, 4))
        for sensor in SENSORS:
            pattern = sensor_pattern(sensor)
            values = seen(light, pattern, rng)
            target = true if pattern.colors is not None else np.repeat(true[..., 1:2], 3, axis=3)
            for registered in (False, True):
                bad = np.zeros(values.shape, bool)
                picture = demosaic(values, bad, pattern, mode="half", registered=registered)
                found.setdefault((sensor, registered), []).append(errors(picture.intensities, target))
    means = {}
    for key, rows in found.items():
        dolp, aolp = np.mean(rows, axis=0)
        means[key] = (float(dolp), float(aolp))
    return means


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=12, help="take every n-th view")
    options = parser.parse_args()
    found = [measured(capture, options.every) for capture in options.captures]
    print("| | DoLP, not registered | registered | AoLP, not registered | registered |")
    print("|---|---|---|---|---|")
    for sensor, name in SENSORS.items():
        dolp = [", ".join(f"{each[sensor, r][0]:.3f}" for each in found) for r in (False, True)]
        aolp = [", ".join(f"{each[sensor, r][1]:.1f}" for each in found) for r in (False, True)]
        print(f"| {name} | {' | '.join(dolp)} | {' | '.join(f'{cell} degrees' for cell in aolp)} |")


if __name__ == "__main__":
    main()
