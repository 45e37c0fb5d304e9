"""``polarguide demo``."""

from __future__ import annotations

import importlib
from pathlib import Path

import polarguide
from polarguide.cli.console import say
from polarguide.cli.evaluate import evaluate
from polarguide.cli.render import render
from polarguide.cli.train import train
from polarguide.core.options import ComputeOptions, SessionOptions, ThreadOptions
from polarguide.training.settings import TrainSettings

STEPS = 2000
FIRST_VIEW = "v022"
FIRST_LAYERS = ("final", "specular", "diffuse", "normal")
FINER = 3
"""How many times finer than the photographs the first picture is."""


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
    scene = polarguide.demo_scene()
    say(f"scene: {scene} (50 views of glossy objects, four polarizer angles each)")
    settings = TrainSettings(steps, seed)
    session = SessionOptions(threads=machine.threads)
    train(scene, out=out, settings=settings, session=session, resume=(out / "run.json").exists())
    evaluate(out, compute=ComputeOptions(machine.threads))
    render(out)
    picture = _first_picture(out)
    say(f"look at {picture}: {FIRST_VIEW}, which training has not seen, and its layers")
    say(
        f"then at {out / 'render' / 'contact_sheet.png'}: rows are views, columns are layers, each beside the true "
        "one if it is known"
    )
    say(f"look around: polarguide view {out}")


def _first_picture(out: Path) -> Path:
    """A test view larger than its photograph, with its layers: what somebody is shown first."""
    layers = importlib.import_module("polarguide.visualization.layers")
    figures = importlib.import_module("polarguide.visualization.figures")
    run = polarguide.open_run(out)
    camera = run.scene.view(FIRST_VIEW).camera
    camera = camera.scaled(FINER, FINER * camera.width, FINER * camera.height)
    result = run.result(camera).to("cpu")
    tiles = [layers.layer_picture(result, name, camera) for name in FIRST_LAYERS]
    path = out / "first_picture.png"
    figures.write_png(path, figures.contact_sheet([tiles], [FIRST_VIEW], FIRST_LAYERS))
    return path
