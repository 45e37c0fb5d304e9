"""Measure the milliseconds of a training step of plain Gaussian splatting and its parts.

A fixed number of Gaussians (no densification), steps 100 to 400 on a scene's training views. The rasterizer's two
native calls are timed. The rest is harmonics, loss, optimizer and autograd. Run it without other work on the machine:
``python benchmarks/speed/training_step.py SCENE --downscale 2 --gaussians 20800``.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

import torch

from polarguide import _native
from polarguide.capture import Scene, load_scene
from polarguide.methods import RECIPES
from polarguide.raster import choose_backend
from polarguide.runs.folder import resolve
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.context import TrainingContext
from polarguide.training.recipe import Recipe, Stage
from polarguide.training.settings import TrainSettings

SKIPPED, LAST = 100, 400
PLAIN = RECIPES["3dgs"]


class Stopwatch:
    """Sum of the seconds of wrapped calls."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                self.seconds += time.perf_counter() - begin

        return run

    def take(self) -> float:
        """Return the seconds and reset them."""
        seconds, self.seconds = self.seconds, 0.0
        return seconds


def recipe_without_densification(added: int) -> Recipe:
    """Plain splatting with all harmonics from the first step, and ``added`` Gaussians around the scene."""
    return replace(
        PLAIN,
        stages=(Stage("steps", 1.0, reflection=False),),
        sh_fractions=(0.0, 0.0, 0.0),
        initialization=replace(PLAIN.initialization, shell=added),
    )


def with_gaussians(scene: Scene, wanted: int) -> tuple[Scene, Recipe]:
    """Return the scene and a recipe that begin with ``wanted`` Gaussians. Points are left out or repeated nearby."""
    shell = min(PLAIN.initialization.shell, wanted // 2)
    count = wanted - shell
    generator = torch.Generator().manual_seed(0)
    points = len(scene.points)
    order = torch.cat([torch.randperm(points, generator=generator) for _ in range(-(-count // points))])[
        :count
    ]
    places = scene.points[order]
    again = torch.arange(count) >= points
    spread = 0.01 * (scene.points.quantile(0.9, dim=0) - scene.points.quantile(0.1, dim=0))
    places[again] += spread * torch.randn(int(again.sum()), 3, generator=generator)
    scene = replace(scene, points=places, point_colors=scene.point_colors[order])
    return scene, recipe_without_densification(shell)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--gaussians", type=int, default=20_800)
    parser.add_argument("--steps", type=int, default=LAST, help="in all; the first quarter is not counted")
    arguments = parser.parse_args()
    skipped = arguments.steps * SKIPPED // LAST
    scene, recipe = with_gaussians(
        load_scene(arguments.scene, downscale=arguments.downscale), arguments.gaussians
    )
    rasterizer = Stopwatch()
    native = _native.Rasterizer
    native.forward, native.backward = rasterizer.timed(native.forward), rasterizer.timed(native.backward)
    settings = resolve(TrainSettings(arguments.steps, 0), scene, recipe)
    trainer, _ = gaussian_training(TrainingContext(scene, recipe, settings, choose_backend("cpu")))
    times = []
    for _ in range(arguments.steps):
        begin = time.perf_counter()
        trainer.step()
        times.append((time.perf_counter() - begin, rasterizer.take()))
    counted = [(1e3 * whole, 1e3 * raster) for whole, raster in times[skipped:]]
    camera = scene.train_views[0].camera
    print(
        f"{scene.name}, {camera.width} x {camera.height}, {len(trainer.state.gaussians):,} Gaussians, "
        f"steps {skipped} to {arguments.steps}, {_native.simd()}, {_native.thread_count()} kernel threads, "
        f"{torch.get_num_threads()} torch threads"
    )
    print("\n| part | median ms | 10 % | 90 % |\n|---|---|---|---|")
    for name, values in (
        ("whole step", [whole for whole, _ in counted]),
        ("rasterizer, both passes", [raster for _, raster in counted]),
        ("everything else", [whole - raster for whole, raster in counted]),
    ):
        tenths = statistics.quantiles(values, n=10)
        print(f"| {name} | {statistics.median(values):.2f} | {tenths[0]:.2f} | {tenths[-1]:.2f} |")


if __name__ == "__main__":
    main()
