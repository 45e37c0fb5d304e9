"""Measure the pictures per second of the viewer while the camera moves: drawn, encoded, and sent to an idle browser.

``python benchmarks/speed/viewer.py RUN [--size 480x360]``. Run it without other work on the machine. The camera follows
an orbit, one pose per picture, at a fixed size.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

import cv2
import torch

from polarguide import open_run
from polarguide.geometry.camera_path import orbit
from polarguide.geometry.scene_frame import scene_frame
from polarguide.shading.result import LAYERS
from polarguide.viewer import run_scenery
from polarguide.viewer.scenery import Appearance, Painter
from polarguide.viewer.session import JPEG_QUALITY

SKIPPED = 3


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--pictures", type=int, default=40)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    opened = open_run(arguments.run)
    shown = run_scenery(opened)
    cameras = list(opened.cameras.values())
    path = [c.extended(width, height) for c in orbit(cameras, arguments.pictures + SKIPPED)]
    print(f"{shown.status} on {opened.scene.name}, {width} x {height}, {torch.get_num_threads()} threads")
    print("layer        ms (10 % to 90 %)   pictures per second")
    for layer in LAYERS:
        painter, seconds = Painter(scene_frame(cameras)), []
        for camera in path:
            began = time.perf_counter()
            picture = painter.paint(shown, camera, Appearance(layer=layer), settled=False)
            if picture is None:
                break
            cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            seconds.append(time.perf_counter() - began)
        if seconds:
            tenths = [1000 * t for t in statistics.quantiles(seconds[SKIPPED:], n=10)]
            middle = statistics.median(seconds[SKIPPED:])
            span = f"({tenths[0]:.0f} to {tenths[-1]:.0f})"
            print(f"{layer:12s} {1000 * middle:4.0f} {span:14s} {1 / middle:8.1f}")


if __name__ == "__main__":
    main()
