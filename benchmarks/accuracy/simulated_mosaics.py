"""Simulate raw mosaics of a color polarization sensor from a capture with four pictures of each view.

Each picture pixel becomes one 2x2 cell of the sensor, so a capture of 612x512 gives mosaics of 1224x1024. The cell
takes the one color of its filter, and its four samples are the four angles. Nothing is interpolated, so ``prepare``
must restore exactly the values that a sensor misses. Unlike in a real sensor, all angles of a cell have the same
position (hence ``--no-register``). Values are 12-bit in 16-bit PNG files.

    python benchmarks/accuracy/simulated_mosaics.py CAPTURE MOSAICS
    polarguide prepare MOSAICS --out SCENE --sensor IMX250MYR --no-register
    python benchmarks/accuracy/pose_error.py SCENE CAPTURE
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.pictures import decode_picture, linear_codes
from polarguide.capture.layout import CaptureFiles, find_layout
from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.capture.view import ANGLES
from polarguide.core.files import read_file

FULL = 4095


def linear_intensities(layout: CaptureFiles, view: str, transfer: str) -> NDArray[np.float64]:
    """Return the intensities of a view in [0, 1], [4, H, W, 3]."""
    pictures = (
        decode_picture(path, read_file(path)) for path in (layout.pictures[view][angle] for angle in ANGLES)
    )
    return np.stack([linear_codes(picture, transfer) for picture in pictures]) / 65535


def mosaic(
    intensities: NDArray[np.float64], *, electrons: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return a 12-bit mosaic [2 H, 2 W] of [4, H, W, 3]. ``electrons`` at full scale define shot noise; 0: no noise."""
    _, height, width, _ = intensities.shape
    pattern = sensor_pattern("IMX250MYR")
    assert pattern.colors is not None
    out = np.empty((2 * height, 2 * width))
    for row, column in np.ndindex(4, 4):
        angle = ANGLES.index(int(pattern.angles[row, column]))
        # Pixel (row, column) of the 4x4 pattern lies in the cell (row // 2, column // 2) of its 2x2 cells.
        cells = intensities[angle, row // 2 :: 2, column // 2 :: 2, int(pattern.colors[row, column])]
        out[row::4, column::4] = cells
    if electrons:
        out = rng.poisson(out * electrons) / electrons
    return np.rint(np.clip(out, 0, 1) * FULL).astype(np.uint16)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, help="folder with I-00, I-45, I-90, I-135 or polar/")
    parser.add_argument("out", type=Path, help="folder for <view>.png")
    parser.add_argument("--transfer", choices=("linear", "srgb"), default="linear")
    parser.add_argument(
        "--electrons", type=float, default=0.0, help="electrons at full scale (10000 is usual)"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    layout = find_layout(options.capture)
    rng = np.random.default_rng(options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    for view in layout.names:
        raw = mosaic(linear_intensities(layout, view, options.transfer), electrons=options.electrons, rng=rng)
        if not cv2.imwrite(str(options.out / f"{view}.png"), raw):
            raise OSError(f"{options.out / view}.png cannot be written")
    print(f"{len(layout.names)} mosaics in {options.out}")


if __name__ == "__main__":
    main()
