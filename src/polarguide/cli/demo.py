"""``polarguide demo``."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from polarguide.cli.common import console, open_run, use_threads
from polarguide.cli.evaluate import evaluate_run
from polarguide.cli.render import render_run
from polarguide.cli.train import train
from polarguide.errors import PolarguideError
from polarguide.runs.folder import CONFIGURATION
from polarguide.shading.result import LAYERS

STEPS = 2000


def demo(*, out: Path = Path("runs/demo"), steps: int = STEPS, seed: int = 0, threads: int = 0) -> None:
    """Train, evaluate and render the small scene that ships with the program.

    Args:
        out: Run folder to write; a finished or interrupted demo there is gone on with.
        steps: Optimizer steps.
        seed: Seed of every random draw.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    with resources.as_file(resources.files("polarguide") / "data" / "demo") as scene:
        if not scene.is_dir():
            raise PolarguideError(
                scene, expected="the demo scene", found="nothing", remedy="Install the package again."
            )
        console.print(f"scene: {scene} (27 views of glossy objects, four polarizer angles each)")
        train(scene, out=out, steps=steps, seed=seed, threads=threads, resume=(out / CONFIGURATION).exists())
        opened = open_run(out)
        evaluate_run(opened)
        sheet = render_run(
            opened, opened.scene.test_views, [n for n in LAYERS if n != "alpha"], out / "render"
        )
    console.print(f"look at {sheet}: rows are rendered and true pictures, columns are layers")
    console.print(f"look around: polarguide view {out}")
