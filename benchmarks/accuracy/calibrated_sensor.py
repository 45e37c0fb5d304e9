"""Measure errors of DoLP and AoLP before and after ``calibrate``, on a simulated sensor.

The sensor has extinction ratios of 20 to 300, angle errors up to 2 degrees and gains of +-3 %. They depend on the
place in the pattern (smoothly over the sensor) or are independent for each pixel. The shots have the noise of 10,000
electrons at full scale. The light of the test has no noise, so the remaining error is that of the calibration. Each
kind of calibration is a row.

    python benchmarks/accuracy/calibrated_sensor.py [--dolp 0.1] [--seeds 3]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "helpers"))

from made_sensor import MadeSensor, dolp_aolp, made_sensor, polarizer_light, write_polarizer_shots

from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide_shots.calibration.calibrate import calibrate_sensor
from polarguide_shots.calibration.settings import CalibrateSettings

SIZE = (128, 192)
TWELVE = [15.0 * index for index in range(12)]
LAMP = list(1 + 0.15 * np.cos(2 * np.radians(np.array(TWELVE) - 25)))
WAYS = {
    "12 known angles": {"angles": "names"},
    "12 unknown angles, flat field": {"flat": True},
    "12 unknown angles, steady light": {},
    "12 known angles, lamp polarized by 15 %": {"angles": "names", "levels": LAMP},
    "12 unknown angles, flat, such a lamp": {"flat": True, "levels": LAMP},
    "5 known angles": {"angles": "names", "degrees": [10.0, 40.0, 75.0, 115.0, 150.0]},
    "every pixel differs; 12 known angles x 8": {"angles": "names", "frames": 8, "single": True},
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dolp", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    print(f"{'':42} {'sensor':10} {'DoLP error before, after':28} {'factor':>7}   AoLP error, degrees")
    for name in ("IMX250MZR", "IMX250MYR"):
        for way, how in WAYS.items():
            rows = []
            for seed in range(options.seeds):
                sensor = made_sensor(name, SIZE, seed=seed, single=bool(how.get("single")))
                with tempfile.TemporaryDirectory() as root:
                    folder = Path(root)
                    write_polarizer_shots(
                        folder, sensor, how.get("degrees", TWELVE), levels=how.get("levels"), level=0.55,
                        frames=how.get("frames", 1), electrons=10_000, black=240, seed=seed,
                    )  # fmt: skip
                    settings = CalibrateSettings(
                        name, angles=how.get("angles"), dark_frame=folder / "dark.png",
                        flat=folder / "flat.png" if how.get("flat") else None,
                    )  # fmt: skip
                    done = calibrate_sensor(folder / "shots", folder / "c.safetensors", settings)
                rows.append(
                    [*errors(sensor, None, options.dolp), *errors(sensor, done.calibration, options.dolp)]
                )
            dolp, aolp, dolp_after, aolp_after = np.mean(rows, axis=0)
            print(
                f"{way:42} {name:10} {dolp:.4f}, {dolp_after:.4f} {dolp / dolp_after:21.1f}   "
                f"{aolp:.2f}, {aolp_after:.2f}",
                flush=True,
            )
    speed()


def speed() -> None:
    """Return the seconds of a first and of a second application to a mosaic of 2448x2048 pixels."""
    rng = np.random.default_rng(0)
    for block in (32, 2):
        rows, columns = -(-2048 // block), -(-2448 // block)
        turn = np.radians([[90, 45], [135, 0]]) + rng.normal(0, 0.01, (rows, columns, 2, 2))
        vectors = (
            np.stack([np.ones_like(turn), 0.95 * np.cos(2 * turn), 0.95 * np.sin(2 * turn)], axis=-1) / 2
        )
        found = AnalyzerCalibration(
            "IMX250MZR", "", (0, 0), (2448, 2048), block, vectors.astype(np.float32), "mean"
        )
        mosaic = rng.uniform(0, 1, (2048, 2448)).astype(np.float32)
        seconds = []
        for _ in range(2):
            begin = time.process_time()
            found.apply(mosaic)
            seconds.append(time.process_time() - begin)
        kind = "vectors of single pixels" if block == 2 else "blocks of 32 pixels"
        print(
            f"2448x2048, {kind}: {seconds[0]:.2f} s of CPU for the first mosaic, {seconds[1]:.2f} s for the next"
        )


if __name__ == "__main__":
    main()
