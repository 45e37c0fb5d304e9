"""Measure errors of DoLP and AoLP before and after ``calibrate``, on a simulated sensor.

The sensor has extinction ratios of 20 to 300, angle errors up to 2 degrees and gains of +-3 %. They depend on the
place in the pattern (smoothly over the sensor) or are independent for each pixel. The shots have the noise of 10,000
electrons at full scale. The light of the test has no noise, so the remaining error is that of the calibration. Prints
a Markdown table with a row for each kind of calibration.

    python benchmarks/accuracy/calibrated_sensor.py [--dolp 0.1] [--seeds 3] > benchmarks/records/calibration.md
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "helpers"))

from made_sensor import MadeSensor, dolp_aolp, made_sensor, polarizer_light, write_polarizer_shots

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide_shots.calibration.calibrate import calibrate_sensor
from polarguide_shots.calibration.settings import CalibrateSettings

SIZE = (128, 192)
TWELVE = [15.0 * index for index in range(12)]
LAMP = list(1 + 0.15 * np.cos(2 * np.radians(np.array(TWELVE) - 25)))
SENSORS = ("IMX250MZR", "IMX250MYR")
WAYS = {
    "12 known angles": {"angles": "names"},
    "12 unknown angles and a flat field": {"flat": True},
    "12 unknown angles, steady light": {},
    "12 known angles, a lamp polarized by 15 %": {"angles": "names", "levels": LAMP},
    "12 unknown angles and a flat field, a lamp polarized by 15 %": {"flat": True, "levels": LAMP},
    "5 known angles": {"angles": "names", "degrees": [10.0, 40.0, 75.0, 115.0, 150.0]},
    "every pixel differs, 12 known angles, 8 shots each": {"angles": "names", "frames": 8, "single": True},
}


def errors(sensor: MadeSensor, calibration: AnalyzerCalibration | None, dolp: float) -> tuple[float, float]:
    """Return mean errors of DoLP and of AoLP (degrees) over the sensor and over light of all angles."""
    wrong, turned = [], []
    for degrees in range(0, 180, 10):
        seen = sensor.sees(0.5 * polarizer_light(degrees) * [1, dolp, dolp]).astype(np.float32)
        found, angle = dolp_aolp(sensor, seen if calibration is None else calibration.apply(seen))
        wrong.append(np.abs(found - dolp).mean())
        turned.append(np.abs((np.degrees(angle) - degrees + 90) % 180 - 90).mean())
    return float(np.mean(wrong)), float(np.mean(turned))


def measured(sensor_name: str, how: dict[str, Any], dolp: float, seeds: int) -> list[float]:
    """Return mean errors over sensors: DoLP and AoLP without calibration, then with it."""
    rows = []
    for seed in range(seeds):
        sensor = made_sensor(sensor_name, SIZE, seed=seed, single=bool(how.get("single")))
        with tempfile.TemporaryDirectory() as root:
            folder = Path(root)
            write_polarizer_shots(
                folder, sensor, how.get("degrees", TWELVE), levels=how.get("levels"), level=0.55,
                frames=how.get("frames", 1), electrons=10_000, black=240, seed=seed,
            )  # fmt: skip
            settings = CalibrateSettings(
                sensor_name, angles=how.get("angles"), dark_frame=folder / "dark.png",
                flat=folder / "flat.png" if how.get("flat") else None,
            )  # fmt: skip
            done = calibrate_sensor(folder / "shots", folder / "c.safetensors", settings)
        rows.append([*errors(sensor, None, dolp), *errors(sensor, done.calibration, dolp)])
    return [float(mean) for mean in np.mean(rows, axis=0)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dolp", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    print("| shots | monochrome: DoLP | AoLP | color: DoLP | AoLP |\n|---|---|---|---|---|")
    factors = []
    without = set()
    for way, how in WAYS.items():
        found = [measured(name, how, options.dolp, options.seeds) for name in SENSORS]
        kind = "every pixel differs, without calibration" if how.get("single") else "without calibration"
        if kind not in without:
            without.add(kind)
            print(row(kind, [each[:2] for each in found]))
        print(row(way, [each[2:] for each in found]), flush=True)
        factors += [
            before / after for each in found for before, after in zip(each[:2], each[2:], strict=True)
        ]
    print(f"\nCalibration divides the errors by {min(factors):.0f} to {max(factors):.0f}.")


def row(name: str, errors: Sequence[Sequence[float]]) -> str:
    """Return a row of the table: errors of DoLP and AoLP for each sensor."""
    cells = [cell for dolp, aolp in errors for cell in (f"{dolp:.4f}", f"{aolp:.2f}°")]
    return f"| {' | '.join((name, *cells))} |"


if __name__ == "__main__":
    main()
