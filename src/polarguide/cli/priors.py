"""``polarguide priors``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

import polarguide
from polarguide.cli.console import console, use_threads
from polarguide.cli.progress import ConsoleReporter
from polarguide.options import SceneOptions, ThreadOptions


def priors(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    run: Path | None = None,
    views: str = "test",
    refractive_index: float = 1.5,
    threshold: float = 0.05,
    reading: SceneOptions = SceneOptions(),
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Pictures of what polarization says about a scene, before or after training.

    S0, DoLP, AoLP, zenith, both separations, polarization normals, those that color differences tell (gray where they
    decide nothing), and the mask of usable pixels. The exact separation
    needs normals: those of a trained run with --run, else the polarization normals themselves, with their ambiguity
    resolved only by the surface facing the camera (a rough guess, and named so in the file).

    Args:
        scene: Scene folder.
        out: Folder to write.
        run: A run trained on this scene (at the same --downscale), whose normals resolve the ambiguity.
        views: test, train, all, or names separated by commas.
        refractive_index: Of the surfaces.
        threshold: DoLP above which a pixel's normal is used.
    """
    use_threads(machine.threads)
    reporter = ConsoleReporter()
    opened = None if run is None else polarguide.open_run(run, reporter=reporter)
    sheet = polarguide.priors(
        scene,
        out,
        run=opened,
        views=views,
        refractive_index=refractive_index,
        threshold=threshold,
        reading=reading,
        reporter=reporter,
    )
    console.print(f"pictures: {out}   contact sheet: {sheet}")
