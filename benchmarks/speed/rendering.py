"""What rendering all layers costs against plain Gaussian splatting of the same Gaussians.

Every test view is drawn in turn as color alone and as all layers, with and without depth; the ratio is taken within
each turn, so that a slow moment of the machine meets both. Run it alone:
``python benchmarks/speed/rendering.py RUN...``.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

import torch

from polarguide import _native
from polarguide.api import Run, open_run
from polarguide.capture import View
from polarguide.shading.gbuffer import render

ROUNDS = 7


def milliseconds(draw: Callable[[], object]) -> float:
    begin = time.perf_counter()
    draw()
    return 1e3 * (time.perf_counter() - begin)


def measure(opened: Run, rounds: int) -> None:
    rows, rasterize = opened.model.state.gaussians, opened.model.backend.rasterize

    def plain(view: View) -> object:
        return render(rows, view.camera, rasterize, normals=False)

    def layers(view: View) -> object:
        return opened.result(view.camera, depth=False).to("cpu")

    def layers_and_depth(view: View) -> object:
        return opened.result(view.camera).to("cpu")

    ways = (plain, layers, layers_and_depth)
    views = opened.scene.test_views
    times: dict[str, list[float]] = {way.__name__: [] for way in ways}
    for turn in range(rounds + 1):
        for view in views:
            for way in ways:
                taken = milliseconds(lambda way=way, view=view: way(view))  # type: ignore[misc]
                if turn:  # the first warms up
                    times[way.__name__].append(taken)
    median = {name: statistics.median(taken) for name, taken in times.items()}
    ratios = [
        statistics.median(a / b for a, b in zip(times[way.__name__], times["plain"], strict=True))
        for way in ways[1:]
    ]
    camera = views[0].camera
    print(
        f"| {opened.folder.name} | {opened.recipe.name} | {camera.width} x {camera.height} | {len(rows):,} | "
        f"{median['plain']:.1f} | {median['layers']:.1f} | {median['layers_and_depth']:.1f} | "
        + " | ".join(f"{ratio:.2f}" for ratio in ratios)
        + " |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    arguments = parser.parse_args()
    print(
        f"{_native.simd()}, {_native.thread_count()} kernel threads, {torch.get_num_threads()} torch threads\n"
    )
    print("| run | recipe | size | Gaussians | color ms | layers ms | with depth ms | ratio | with depth |")
    print("|---|---|---|---|---|---|---|---|---|")
    with torch.no_grad():
        for run in arguments.runs:
            measure(open_run(run), arguments.rounds)


if __name__ == "__main__":
    main()
