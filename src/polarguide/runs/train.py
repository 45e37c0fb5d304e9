"""The loop of ``polarguide train``: progress, checkpoints, a clean stop, and whoever looks on."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from polarguide.cli.common import console
from polarguide.cli.meter import LOG_EVERY, Meter, progress_bar
from polarguide.cli.view import announce
from polarguide.errors import PolarguideError
from polarguide.runs.point_cloud import write_run_ply
from polarguide.runs.folder import PLY, RunLog, save_checkpoint
from polarguide.training.stopwatch import Stopwatch
from polarguide.training.trainer import Trainer
from polarguide.viewer import Viewer, photographs, shown_training

Look = Callable[[Callable[[], bool]], None]
"""Lets visitors look between two steps; asks what it is given whether training should end."""

PATIENCE = 0.2  # seconds between two looks at whether a waiting training should end


class _Interrupt:
    """Turns the first Ctrl-C (or SIGTERM) into a flag that the loop looks at between two steps."""

    def __init__(self) -> None:
        self.asked = False
        self._old = {s: signal.signal(s, self._ask) for s in (signal.SIGINT, signal.SIGTERM)}

    def _ask(self, number: int, _: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True

    def restore(self) -> None:
        """Put the previous handlers back."""
        for number, handler in self._old.items():
            signal.signal(number, handler)


def train_run(trainer: Trainer, out: Path, *, checkpoint_every: int, look: Look | None = None) -> None:
    """Train to the end with progress, checkpoints and a log; then write the PLY. Rank 0 alone writes.

    ``look`` is called between steps; its time does not count.
    """
    ranks, leads = trainer.ranks, trainer.ranks.rank == 0
    log = RunLog(out) if leads else None
    if log is not None:
        log.cut(trainer.state.step)
    stopwatch = Stopwatch(*log.elapsed()) if log else Stopwatch()
    interrupt = _Interrupt()
    try:
        with progress_bar() as progress:
            task = progress.add_task("", total=trainer.settings.steps, completed=trainer.state.step, note="")
            meter = Meter(progress, task, log, stopwatch)
            stopped = False
            while trainer.state.step < trainer.settings.steps and not stopped:
                meter.show(trainer.step())
                if trainer.state.step % checkpoint_every == 0:
                    with stopwatch.paused():
                        meter.read()
                        _save(trainer, out)
                if look is not None:
                    with stopwatch.paused():
                        look(lambda: interrupt.asked)
                # Several ranks stop after the same step, so they have to ask each other, which takes time.
                if ranks.world == 1 or trainer.state.step % LOG_EVERY == 0:
                    stopped = ranks.any(interrupt.asked)
            meter.read()
        _save(trainer, out)
        if stopped:
            console.print(
                f"stopped after step {trainer.state.step}; go on with the same command and --resume"
            )
            raise KeyboardInterrupt
    finally:
        interrupt.restore()
    if leads:
        write_run_ply(out / PLY, trainer.state, trainer.shading)


def _save(trainer: Trainer, out: Path) -> None:
    """A checkpoint of what all ranks have seen, by rank 0."""
    trainer.exchange_statistics()
    if trainer.ranks.rank == 0:
        save_checkpoint(out, trainer.state)


@contextmanager
def watched(trainer: Trainer, host: str, port: int) -> Iterator[Look]:
    """A viewer over a training, for ``train_run``.

    Raises:
        PolarguideError: several processes train, or the address cannot be listened at.
    """
    if trainer.ranks.world > 1:
        raise PolarguideError(
            "--viewer",
            expected="one process",
            found=f"{trainer.ranks.world}",
            remedy="Leave it out, and look at the checkpoints: polarguide view RUN.",
        )
    scene = trainer.scene
    viewer = Viewer(
        lambda: shown_training(trainer),
        photographs(scene),
        shading=trainer.shading,
        trains=True,
        host=host,
        port=port,
        title=f"polarguide {scene.name}",
    )
    announce(viewer, host)

    def look(ends: Callable[[], bool]) -> None:
        viewer.refresh()
        viewer.serve()
        while viewer.paused and not ends():
            viewer.serve(PATIENCE)

    try:
        yield look
    finally:
        viewer.close()
