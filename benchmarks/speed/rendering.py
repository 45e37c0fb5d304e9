"""Measure the cost of all layers against plain Gaussian splatting of the same Gaussians.

Each test view is drawn in turn as color alone and as all layers. All layers are drawn without depth, with depth, and
with normals and depth of the surface. The ratio is computed within each turn, so that a slow moment of the machine
affects all. Run it without other work on the machine: ``python benchmarks/speed/rendering.py RUN... [--size 1920x1080]
[--threads 1 2]``.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

import torch

from polarguide import Run, _native, open_run
from polarguide.core.system import keep_freed_memory
from polarguide.geometry.camera import Camera
from polarguide.raster import use_threads
from polarguide.shading.gbuffer import RenderRequest, render

ROUNDS = 7


def milliseconds(draw: Callable[[], object]) -> float:
    begin = time.perf_counter()
    draw()
    return 1e3 * (time.perf_counter() - begin)


def shown_at(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """Return the camera with a picture of this size and the same field of view."""
    if size is None:
        return camera
    factor = max(size[0] / camera.width, size[1] / camera.height)
    larger = camera.scaled(factor, *size)
    middle = (size[0] - factor * camera.width) / 2, (size[1] - factor * camera.height) / 2
    return replace(larger, cx=larger.cx + middle[0], cy=larger.cy + middle[1])


def measure(opened: Run, rounds: int, size: tuple[int, int] | None, threads: int) -> None:
    use_threads(threads)
    rows, rasterize = opened.model.state.gaussians, opened.model.backend.rasterize

    def plain(camera: Camera) -> object:
        return render(rows, camera, rasterize, RenderRequest(normals=False))

    def layers(camera: Camera) -> object:
        return opened.result(camera, depth=False, surface=False).to("cpu")

    def layers_and_depth(camera: Camera) -> object:
        return opened.result(camera, surface=False).to("cpu")

    def surface(camera: Camera) -> object:
        return opened.result(camera).to("cpu")

    ways = (plain, layers, layers_and_depth, surface)
    cameras = [shown_at(view.camera, size) for view in opened.scene.test_views]
    times: dict[str, list[float]] = {way.__name__: [] for way in ways}
    for turn in range(rounds + 1):
        for camera in cameras:
            for way in ways:
                taken = milliseconds(lambda way=way, camera=camera: way(camera))  # type: ignore[misc]
                if turn:  # the first is a warm-up
                    times[way.__name__].append(taken)
    median = {name: statistics.median(taken) for name, taken in times.items()}
    ratios = [
        statistics.median(a / b for a, b in zip(times[way.__name__], times["plain"], strict=True))
        for way in ways[1:]
    ]
    camera = cameras[0]
    print(
        f"| {opened.scene.name} | {opened.recipe.name} | {threads} | {camera.width} x {camera.height} "
        f"| {len(rows):,} | "
        + "".join(f"{median[way.__name__]:.1f} | " for way in ways)
        + " | ".join(f"{ratio:.2f}" for ratio in ratios)
        + " |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--size", help="as 1920x1080; that of the views where not given")
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    arguments = parser.parse_args()
    size = tuple(int(side) for side in arguments.size.split("x")) if arguments.size else None
    assert size is None or len(size) == 2
    keep_freed_memory()  # as the command line does
    print(f"{_native.simd()}\n")
    print(
        "| scene | recipe | threads | size | Gaussians | color ms | layers ms | with depth ms | of the surface ms "
        "| ratio | with depth | of the surface |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    with torch.no_grad():
        for run in arguments.runs:
            for threads in arguments.threads:
                measure(open_run(run), arguments.rounds, size, threads)


if __name__ == "__main__":
    main()
