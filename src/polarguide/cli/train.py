"""``polarguide train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

import polarguide
from polarguide.cli.console import ConsoleReporter, say
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.core.system import StopSignals
from polarguide.training.settings import TrainSettings


def train(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    recipe: str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    reading: SceneOptions = SceneOptions(),
    session: SessionOptions = SessionOptions(),
    resume: bool = False,
) -> None:
    """Train a recipe on a scene.

    Can be stopped with Ctrl-C at any time: the state is saved, and --resume goes on to the same result. Several
    processes share the views of each step: torchrun --nproc-per-node N --no-python polarguide train ...

    Args:
        scene: Scene folder: polar/<view>_000|_045|_090|_135.png or four folders I-00 I-45 I-90 I-135, and a COLMAP
            model in sparse/0.
        out: Run folder to write (configuration, checkpoint, log, PLY).
        recipe: Which method: polarguide-stokes (renders the measured polarization, too), polarguide (PolarGuide-GSDR's
            stages with repaired physics), polarguide-paper; 3dgs, 3dgs-dr and ref-gs, which ignore polarization; gnerp,
            a field in place of Gaussians; an ablation of one, such as polarguide:without-normals; or a recipe of an
            installed package.
        resume: Go on with the run in --out.
    """
    with StopSignals() as should_stop:
        try:
            polarguide.train(
                scene,
                out,
                recipe=recipe,
                settings=settings,
                session=session,
                reading=reading,
                resume=resume,
                reporter=ConsoleReporter(),
                should_stop=should_stop,
            )
        except KeyboardInterrupt as stopped:
            if str(stopped):  # it was asked to stop, and says after which step it did
                say(f"{stopped}; go on with the same command and --resume")
            raise
    say(f"trained: {out}   next: polarguide eval {out}   polarguide view {out}")
