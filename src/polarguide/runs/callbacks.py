"""The callbacks of a run: progress with a log, checkpoints, viewer and a clean stop. They know no method."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch

from polarguide.core.options import SessionOptions
from polarguide.core.progress import Advance, Reporter
from polarguide.core.system import MemoryBound
from polarguide.runs.folder import RunLog, save_checkpoint
from polarguide.runs.stopwatch import Stopwatch
from polarguide.training.callback import Callback
from polarguide.training.loop import Loop
from polarguide.training.losses import refuse_diverged
from polarguide.training.settings import StepReport

LOG_EVERY = 10
"""Steps from one line of the log to the next."""
SMOOTHING = 0.98
"""Weight of earlier steps in the shown loss and PSNR."""
Ends = Callable[[], bool]
"""Returns true to end the training."""
Look = Callable[[Ends], None]
"""Runs between two steps, such as a viewer; its argument tells when the training should end."""


class TrainingStopped(KeyboardInterrupt):
    """The training was stopped on request; its state is saved.

    Attributes:
        step: number of finished steps.
    """

    def __init__(self, step: int) -> None:
        super().__init__(f"stopped after step {step}")
        self.step = step


class Progress(Callback[Loop]):
    """Smooths the reports of steps for the display, and writes every tenth into the log.

    Reports are read ten at a time: on a GPU, reading waits for it.

    Args:
        advance: receives progress.
        log: log of the run; None: not written by this rank.
        stopwatch: time of the training.
    """

    def __init__(self, advance: Advance, log: RunLog | None, stopwatch: Stopwatch) -> None:
        self._advance = advance
        self._log = log
        self._stopwatch = stopwatch
        self._loss = math.nan
        self._psnr = math.nan
        self._began = stopwatch.read()[0]
        self._first = -1
        self._waiting: list[StepReport] = []

    def after_step(self, loop: Loop, report: StepReport) -> None:
        """Take the report of a step."""
        if self._first < 0:
            self._first = report.done - 1
        elif report.step == 0 and self._log is not None:
            self._log.cut(0)  # the training has begun again
        self._waiting.append(report)
        if (report.step + 1) % LOG_EVERY:
            return
        loss, psnr = self.read()
        if self._log is None:
            return
        seconds, alone = self._stopwatch.read()
        self._log.append(
            step=report.step,
            stage=report.stage,
            loss=round(loss, 6),
            psnr=round(psnr, 3),
            gaussians=report.gaussians,
            seconds=round(seconds, 3),
            alone=alone,
        )

    def read(self) -> tuple[float, float]:
        """Read the waiting reports; return the loss and the PSNR of the last.

        Raises:
            PolarguideError: a loss that is not finite.
        """
        if not self._waiting:
            return math.nan, math.nan
        last = self._waiting[-1]
        measured = torch.stack([report.measured for report in self._waiting]).cpu()
        self._waiting.clear()
        refuse_diverged(measured[:, 2])
        for loss, psnr, _ in measured.tolist():
            keep = 0.0 if math.isnan(self._loss) else SMOOTHING
            self._loss = loss if keep == 0 else keep * self._loss + (1 - keep) * loss
            self._psnr = psnr if keep == 0 else keep * self._psnr + (1 - keep) * psnr
        seconds, _ = self._stopwatch.read()
        rate = (last.done - self._first) / max(1e-9, seconds - self._began)
        count = "" if last.gaussians is None else f"{last.gaussians:,} Gaussians  "
        note = f"{last.stage}  loss {self._loss:.4f}  PSNR {self._psnr:.2f} dB  {count}{rate:.1f} it/s"
        self._advance(last.done, note=note, seconds=seconds)
        return loss, psnr


class Checkpoints(Callback[Loop]):
    """Saves the state now and then. Rank 0 alone writes.

    Args:
        out: the run folder. session: number of steps between two checkpoints, and their contents.
        progress: read before a checkpoint, so that no state of a diverged training is saved.
        stopwatch: stands still during a checkpoint.
    """

    def __init__(self, out: Path, session: SessionOptions, progress: Progress, stopwatch: Stopwatch) -> None:
        self._out = out
        self._session = session
        self._progress = progress
        self._stopwatch = stopwatch

    def after_step(self, loop: Loop, report: StepReport) -> None:
        """Save a checkpoint if it is due; the state after the last step is saved at the end."""
        step = loop.state.step
        if step % self._session.checkpoint_every == 0 and step < loop.settings.steps:
            with self._stopwatch.paused():
                self._progress.read()
                self.save(loop)

    def save(self, loop: Loop) -> None:
        """Save the state, as all ranks have seen it. Every rank calls it."""
        state = loop.saved_state()
        if loop.ranks.rank == 0:
            goes_on = state.step < loop.settings.steps
            save_checkpoint(self._out, state, optimizer=goes_on or self._session.keep_optimizer)


class Viewing(Callback[Loop]):
    """Runs a viewer between steps, while the stopwatch stands still."""

    def __init__(self, look: Look, should_stop: Ends, stopwatch: Stopwatch) -> None:
        self._look = look
        self._should_stop = should_stop
        self._stopwatch = stopwatch

    def after_step(self, loop: Loop, report: StepReport) -> None:
        """Let the viewer work."""
        with self._stopwatch.paused():
            self._look(self._should_stop)


class MemoryLimit(Callback[Loop]):
    """Returns freed memory to the system between steps."""

    def __init__(self, memory: MemoryBound) -> None:
        self._memory = memory

    def after_step(self, loop: Loop, report: StepReport) -> None:
        """Compare the memory of the process with its limit."""
        self._memory.keep()


class Stop(Callback[Loop]):
    """Ends the training on request, after the same step on all ranks."""

    def __init__(self, should_stop: Ends) -> None:
        self._should_stop = should_stop

    def after_step(self, loop: Loop, report: StepReport) -> None:
        """Check for a request to end the training."""
        self.check(loop)

    def check(self, loop: Loop) -> None:
        """Raise TrainingStopped if the training should end before its last step."""
        step = loop.state.step
        # Several ranks have to ask each other, which takes time.
        due = step < loop.settings.steps and (loop.ranks.world == 1 or step % LOG_EVERY == 0)
        if due and loop.ranks.any(self._should_stop()):
            raise TrainingStopped(step)


def run_to_the_end(
    loop: Loop,
    out: Path,
    session: SessionOptions,
    reporter: Reporter,
    should_stop: Ends,
    look: Look | None,
    memory: MemoryBound,
) -> float:
    """Train to the end with progress, checkpoints and a log. Rank 0 alone writes.

    Args:
        loop: the loop; observed by the callbacks of this module.
        out: the run folder. session: number of steps between two checkpoints.
        reporter: receives progress. should_stop: returns true to end the training.
        look: called between steps; None: nothing. memory: returns freed memory to the system.

    Returns:
        Seconds of the training.

    Raises:
        TrainingStopped: ``should_stop`` returned true; the state is saved.
    """
    log = RunLog(out) if loop.ranks.rank == 0 else None
    if log is not None:
        log.cut(loop.state.step)
    stopwatch = Stopwatch(*(log.elapsed() if log else (0.0, True)))
    stop = Stop(should_stop)
    stopped: TrainingStopped | None = None
    with reporter.track("training", loop.total) as advance:
        progress = Progress(advance, log, stopwatch)
        checkpoints = Checkpoints(out, session, progress, stopwatch)
        viewing = [] if look is None else [Viewing(look, should_stop, stopwatch)]
        loop.observers += [progress, MemoryLimit(memory), checkpoints, *viewing, stop]
        advance(loop.done, seconds=stopwatch.read()[0])
        try:
            stop.check(loop)
            loop.run()
        except TrainingStopped as error:
            stopped = error
        except KeyboardInterrupt:
            if loop.ranks.world == 1 and loop.whole:
                checkpoints.save(loop)
            raise
        progress.read()
    checkpoints.save(loop)
    if stopped is not None:
        raise stopped
    return stopwatch.read()[0]
