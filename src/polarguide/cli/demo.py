"""``polarguide demo``."""

from __future__ import annotations

from pathlib import Path

import polarguide
from polarguide.cli.console import console
from polarguide.cli.evaluate import evaluate
from polarguide.cli.render import render
from polarguide.cli.train import train
from polarguide.options import ComputeOptions, SessionOptions, ThreadOptions
from polarguide.training.settings import TrainSettings

STEPS = 2000


def demo(
    *,
    out: Path = Path("runs/demo"),
    steps: int = STEPS,
    seed: int = 0,
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Train, evaluate and render the small scene that ships with the program.

    Args:
        out: Run folder to write; a finished or interrupted demo there is gone on with.
        steps: Optimizer steps.
        seed: Seed of every random draw.
    """
    with polarguide.demo_scene() as scene:
        console.print(f"scene: {scene} (27 views of glossy objects, four polarizer angles each)")
        settings = TrainSettings(steps, seed, views_per_step=0)
        session = SessionOptions(threads=machine.threads)
        train(scene, out=out, settings=settings, session=session, resume=(out / "run.json").exists())
        evaluate(out, compute=ComputeOptions(machine.threads))
        render(out)
    console.print(
        f"look at {out / 'render' / 'contact_sheet.png'}: rows are views, columns are layers, each beside the true "
        "one if it is known"
    )
    console.print(f"look around: polarguide view {out}")
