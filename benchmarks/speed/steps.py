"""Measure the parts of a training step, for each recipe and number of threads. ``make speed`` calls it.

    python benchmarks/speed/steps.py [SCENE_OR_RUN] [--recipes 3dgs polarguide-stokes] [--threads 1 2 4] [--downscale 1]

With a run, steps are those of the longest stage at full size, with its trained Gaussians. With a scene, they are those
of the first step, with Gaussians at the points of its model. Each view is visited once before it is timed, so that
priors, which are computed once between two refreshes, have their own line. The native calls are timed.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch is imported

from polarguide import _native, open_run
from polarguide.capture import load_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.system import keep_freed_memory
from polarguide.gaussians.gaussians import Trained
from polarguide.methods import recipe_named
from polarguide.raster import choose_backend, use_threads
from polarguide.runs.folder import CONFIGURATION, load_checkpoint, resolve
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.context import TrainingContext
from polarguide.training.feed import Feed
from polarguide.training.loop import TrainingLoop
from polarguide.training.settings import TrainSettings

DEMO = Path(__file__).resolve().parents[2] / "src/polarguide/data/demo"
PARTS = {
    "rasterizer forward": ("Rasterizer.forward",),
    "rasterizer backward": ("Rasterizer.backward",),
    "harmonics, axes": ("Splatting.forward", "Splatting.backward"),
    "reflection": (
        *("turn", "reflect_forward"),
        *("reflect_backward_layers", "cubemap_backward", "mips_backward", "reflect_backward_directions"),
        *("gbuffer_split", "gbuffer_join", "metal_layers", "metal_backward"),
    ),
    "photometric terms": ("photometric",),
    "normals, Stokes": ("polarization", "direction", "consistency"),
    "flatness": ("shortest_sum", "shortest_gradient"),
}


class Clock:
    """Sums of milliseconds by part."""

    def __init__(self) -> None:
        self.parts: dict[str, float] = {}

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                self.parts[part] = self.parts.get(part, 0.0) + 1e3 * (time.perf_counter() - begin)

        return run

    def watch(self) -> None:
        """Start timing all parts."""
        for part, names in PARTS.items():
            for name in names:
                holder, _, attribute = name.rpartition(".")
                of = getattr(_native, holder) if holder else _native
                setattr(of, attribute, self.timed(part, getattr(of, attribute)))
        Trained.step = self.timed("Adam", Trained.step)  # type: ignore[method-assign]
        Feed.targets = self.timed("targets", Feed.targets)  # type: ignore[method-assign]

    def take(self) -> dict[str, float]:
        """Return the sums and reset them."""
        found, self.parts = self.parts, {}
        return found


def measured(trainer: TrainingLoop, clock: Clock, steps: int) -> tuple[dict[str, float], float]:
    """Return medians of the parts of a step in the longest stage, and of the priors of a view, in milliseconds."""
    schedule, last = trainer.schedule, trainer.settings.steps
    every, coarse = trainer.context.recipe.densification.every, trainer.context.recipe.coarse
    largest = max(view.camera.width * view.camera.height for view in trainer.context.scene.train_views)
    # Full-size pictures: the first steps reduce large ones.
    first = math.ceil(coarse.share * last) if largest >= coarse.pixels else 1
    names = [schedule.at(step).stage.name for step in range(first, last - 1)]
    longest = statistics.mode(names)
    calm = [
        step
        for step, name in enumerate(names, first)
        if name == longest and not schedule.at(step).actions and (step + 1) % every
    ][:steps]
    rows, priors = [], []
    for place, step in enumerate((calm[0], *calm)):
        seen = {}
        for turn in ("new", "again"):
            trainer.state.step = step
            clock.take()
            begin = time.perf_counter()
            trainer.step()
            whole = 1e3 * (time.perf_counter() - begin)
            seen[turn] = {"whole step": whole, **clock.take()}
        if place:
            rows.append(seen["again"])
            priors.append(seen["new"].get("targets", 0.0) - seen["again"].get("targets", 0.0))
    names = ["whole step", *PARTS, "Adam", "targets"]
    found = {name: statistics.median(row.get(name, 0.0) for row in rows) for name in names}
    rest = [
        row["whole step"] - sum(value for name, value in row.items() if name != "whole step") for row in rows
    ]
    return {**found, "everything else": statistics.median(rest)}, statistics.median(priors)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, nargs="?", default=DEMO)
    parser.add_argument("--recipes", nargs="+", default=None, help="of a scene; a run has its own")
    parser.add_argument("--threads", type=int, nargs="+", default=None)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--steps", type=int, default=15)
    options = parser.parse_args()
    keep_freed_memory()
    clock = Clock()
    clock.watch()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = options.threads or [count for count in (1, 2, 4, 8, 16, 32, 64) if count <= cores]
    is_run = (options.source / CONFIGURATION).exists()
    run = open_run(options.source, device="cpu") if is_run else None
    scene = run.scene if run is not None else load_scene(options.source, downscale=options.downscale)
    names = [run.recipe.name] if run is not None else options.recipes or ["3dgs", "polarguide-stokes"]
    camera = scene.train_views[0].camera
    for name in names:
        columns = []
        for count in threads:
            use_threads(count)
            recipe = run.recipe if run is not None else recipe_named(name)
            state = load_checkpoint(options.source, recipe) if run is not None else None
            if state is not None:
                # Without its guide, the training computes the priors of each view again.
                state.extra = {
                    name: values for name, values in state.extra.items() if not name.startswith("frozen.")
                }
            settings = resolve(TrainSettings(5000, 0), scene, recipe)
            context = TrainingContext(scene, recipe, settings, choose_backend("cpu"))
            trainer, _ = gaussian_training(context, state)
            columns.append(measured(trainer, clock, options.steps))
            gaussians = len(trainer.state.gaussians)
        kind = "trained" if run is not None else "first"
        print(
            f"\n{name} on {scene.name}, {camera.width} x {camera.height}, {gaussians:,} {kind} Gaussians, "
            f"{_native.simd()}, {cores} cores; milliseconds, medians of {options.steps} steps\n"
        )
        print("| part | " + " | ".join(f"{count} thread{'s' * (count > 1)}" for count in threads) + " |")
        print("|---" * (1 + len(threads)) + "|")
        for part in columns[0][0]:
            print(f"| {part} | " + " | ".join(f"{found[part]:.1f}" for found, _ in columns) + " |")
        print("| priors of a view | " + " | ".join(f"{priors:.0f}" for _, priors in columns) + " |")


if __name__ == "__main__":
    try:
        main()
    except PolarguideError as error:
        raise SystemExit(f"error: {error}") from None
