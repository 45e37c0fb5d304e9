"""``polarguide train``."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Annotated

import tyro

import polarguide
from polarguide.cli.console import console
from polarguide.cli.progress import REPORTER
from polarguide.options import SceneOptions, SessionOptions
from polarguide.system import process_count
from polarguide.training.settings import TrainSettings

# torchrun ends the others when one process is lost. Outside the loop, which stops by itself, they live this much
# longer, so that one of them can say what happened.
LAST_WORDS_SECONDS = 5.0


def train(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    recipe: str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(views_per_step=0),
    reading: SceneOptions = SceneOptions(),
    session: SessionOptions = SessionOptions(),
    resume: bool = False,
) -> None:
    """Train a recipe on a scene.

    Can be stopped with Ctrl-C at any time: the state is saved, and --resume goes on to the same result. Several
    processes share the views of each step: torchrun --nproc-per-node N -m polarguide train ...

    Args:
        scene: Scene folder: polar/<view>_000|_045|_090|_135.png or four folders I-00 I-45 I-90 I-135, and a COLMAP
            model in sparse/0.
        out: Run folder to write (configuration, checkpoint, log, PLY).
        recipe: Which method: polarguide-stokes (renders the measured polarization, too), polarguide (the paper's stages
            with repaired physics), polarguide-paper, 3dgs, 3dgs-dr, ref-gs (these three ignore polarization), or an
            ablation of one, such as polarguide:without-normals.
        resume: Go on with the run in --out.
    """
    with _StopSignals() as should_stop:
        try:
            polarguide.train(
                scene,
                out,
                recipe=recipe,
                settings=settings,
                session=session,
                reading=reading,
                resume=resume,
                reporter=REPORTER,
                should_stop=should_stop,
            )
        except KeyboardInterrupt as stopped:
            if str(stopped):  # it was asked to stop, and says after which step it did
                console.print(f"{stopped}; go on with the same command and --resume")
            raise
    console.print(f"trained: {out}   next: polarguide eval {out}   polarguide view {out}")


class _StopSignals:
    """Turns the first Ctrl-C (or SIGTERM) into the answer to whether training should stop.

    Before that has been asked for the first time, they interrupt at once.
    """

    def __init__(self) -> None:
        self.asked = self._trains = False

    def __enter__(self) -> _StopSignals:
        self._old = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        self._trains = True
        return self.asked

    def _ask(self, number: int, _: FrameType | None) -> None:
        if self._trains:
            if self.asked and number == signal.SIGINT:
                raise KeyboardInterrupt
            self.asked = True
        elif number == signal.SIGTERM and process_count() > 1:
            timer = threading.Timer(LAST_WORDS_SECONDS, os._exit, (128 + number,))
            timer.daemon = True
            timer.start()
        else:
            raise KeyboardInterrupt
