"""Callbacks of a run for any method: progress, log, checkpoints, viewer, memory limit, and end on request."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from polarguide.core.options import SessionOptions
from polarguide.core.progress import Advance, Reporter
from polarguide.core.system import MEBIBYTE, MemoryBound, machine_busy_seconds, peak_memory_mib
from polarguide.runs.folder import RunLog, save_checkpoint
from polarguide.runs.memory_plan import in_gigabytes
from polarguide.training.callback import Callback, Loop
from polarguide.training.losses import refuse_diverged
from polarguide.training.settings import StepReport

FOREIGN_SHARE = 0.10
"""Load by other processes, as a share of one core, above which a measured time is invalid."""


class Stopwatch:
    """Stopwatch for the wall time of an operation, which also detects other busy processes.

    Args:
        seconds: time that was measured before the operation was resumed.
        alone: True if no other process was busy during that time.
    """

    def __init__(self, seconds: float = 0.0, alone: bool = True) -> None:
        self._before = seconds
        self._alone = alone
        self._pause = 0.0
        self._start = time.perf_counter()
        self._own = time.process_time()
        self._machine = machine_busy_seconds()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time inside the context."""
        begin = time.perf_counter()
        yield
        self._pause += time.perf_counter() - begin

    def read(self) -> tuple[float, bool]:
        """Return a tuple of the elapsed seconds, and True if no other process was busy."""
        wall = time.perf_counter() - self._start
        foreign = (machine_busy_seconds() - self._machine) - (time.process_time() - self._own)
        alone = self._alone and foreign <= FOREIGN_SHARE * wall + 0.5
        return self._before + wall - self._pause, alone


def in_words(seconds: float) -> str:
    """Format a time as 40 s, 12 min or 1 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


LOG_EVERY = 10
"""Number of steps between two lines of the log."""
CURVE_POINTS = 10
"""Number of scores of held-out views in the log of a training."""
SMOOTHING = 0.98
"""Weight of earlier steps in the displayed loss and PSNR."""
Ends = Callable[[], bool]
"""Function that returns True to end the training."""
HeldOutScore = Callable[[], float | None]
"""Function that returns the mean PSNR of a few held-out views in dB; None if it examines no view."""
Look = Callable[[Ends], None]
"""Function that runs between two steps, such as a viewer. Its argument returns True when the training should end."""


class TrainingStopped(KeyboardInterrupt):
    """Exception that ends a training on request, after its state was saved.

    Attributes:
        step: number of finished steps.
    """

    def __init__(self, step: int) -> None:
        super().__init__(f"stopped after step {step}")
        self.step = step


class Progress(Callback[Loop]):
    """Callback that shows progress with smoothed loss and PSNR, and logs every tenth step.

    Reports are read in batches of ten, because reading waits for the GPU.

    Args:
        advance: function that receives progress.
        log: log of the run.
        stopwatch: stopwatch of the training.
        held_out: function that scores held-out views, ``CURVE_POINTS`` times in a training. The scores go to the log;
            no decision uses them.
    """

    def __init__(
        self, advance: Advance, log: RunLog, stopwatch: Stopwatch, held_out: HeldOutScore = lambda: None
    ) -> None:
        self._advance = advance
        self._log = log
        self._stopwatch = stopwatch
        self._held_out = held_out
        self._smooth: Tensor | None = None
        self._began = stopwatch.read()[0]
        self._first = -1
        self._waiting: list[StepReport] = []

    def after_step(self, loop: Loop, report: StepReport) -> None:
        if self._first < 0:
            self._first = report.done - 1
        elif report.step == 0:
            self._log.cut(0)  # the training has begun again
        self._waiting.append(report)
        if (report.step + 1) % LOG_EVERY:
            return
        loss, psnr = self.read()
        seconds, alone = self._stopwatch.read()
        held_out = None
        if report.done * CURVE_POINTS // loop.total > (report.done - LOG_EVERY) * CURVE_POINTS // loop.total:
            with self._stopwatch.paused():
                held_out = self._held_out()
        self._log.append(
            step=report.step,
            stage=report.stage,
            loss=round(loss, 6),
            psnr=round(psnr, 3),
            gaussians=report.gaussians,
            seconds=round(seconds, 3),
            alone=alone,
            **({} if held_out is None else {"held_out": round(held_out, 3)}),
        )

    def read(self) -> tuple[float, float]:
        """Read the collected reports, and return the loss and the PSNR of the last one.

        Raises:
            PolarguideError: a loss is not finite.
        """
        if not self._waiting:
            return math.nan, math.nan
        last = self._waiting[-1]
        measured = torch.stack([report.measured for report in self._waiting]).cpu()
        self._waiting.clear()
        refuse_diverged(measured[:, 2])
        values = measured[:, :2]
        smooth = values[0] if self._smooth is None else self._smooth
        for row in values:
            smooth = SMOOTHING * smooth + (1 - SMOOTHING) * row
        self._smooth = smooth
        seconds, _ = self._stopwatch.read()
        rate = (last.done - self._first) / max(1e-9, seconds - self._began)
        count = "" if last.gaussians is None else f"{last.gaussians:,} Gaussians  "
        loss, psnr = smooth.tolist()
        note = f"{last.stage}  loss {loss:.4f}  PSNR {psnr:.2f} dB  {count}{rate:.1f} it/s"
        self._advance(last.done, note=note, seconds=seconds)
        loss, psnr = values[-1].tolist()
        return loss, psnr


@dataclass(eq=False)
class Checkpoints(Callback[Loop]):
    """Callback that saves checkpoints at regular intervals.

    Args:
        out: the run folder.
        session: options with the number of steps between two checkpoints.
        progress: callback whose reports are read before a checkpoint, so that a diverged state is not saved.
        stopwatch: stopwatch of the training, which is paused during a checkpoint.
    """

    out: Path
    session: SessionOptions
    progress: Progress
    stopwatch: Stopwatch

    def after_step(self, loop: Loop, report: StepReport) -> None:
        step = loop.state.step
        if step % self.session.checkpoint_every == 0 and step < loop.settings.steps:
            with self.stopwatch.paused():
                self.progress.read()
                self.save(loop)

    def at_end(self, loop: Loop) -> None:
        self.progress.read()
        self.save(loop)

    def save(self, loop: Loop) -> None:
        """Save the state."""
        unfinished = loop.state.step < loop.settings.steps
        save_checkpoint(self.out, loop.state, optimizer=unfinished or self.session.keep_optimizer)


@dataclass(eq=False)
class Viewing(Callback[Loop]):
    """Callback that runs a viewer between steps, while the stopwatch is paused."""

    look: Look
    should_stop: Ends
    stopwatch: Stopwatch

    def after_step(self, loop: Loop, report: StepReport) -> None:
        with self.stopwatch.paused():
            self.look(self.should_stop)


@dataclass(eq=False)
class MemoryLimit(Callback[Loop]):
    """Callback that returns freed memory to the system between steps."""

    memory: MemoryBound

    def after_step(self, loop: Loop, report: StepReport) -> None:
        self.memory.keep()


@dataclass(eq=False)
class Stop(Callback[Loop]):
    """Callback that ends the training on request."""

    should_stop: Ends

    def after_step(self, loop: Loop, report: StepReport) -> None:
        self.check(loop)

    def check(self, loop: Loop) -> None:
        """Raise TrainingStopped if the training should end before its last step."""
        step = loop.state.step
        if step < loop.settings.steps and self.should_stop():
            raise TrainingStopped(step)


@dataclass(eq=False)
class ResourceReport(Callback[Loop]):
    """Callback that reports the time and the memory of a finished training.

    Args:
        reporter: receives the report.
        stopwatch: stopwatch of the training.
        planned: planned memory in bytes.
    """

    reporter: Reporter
    stopwatch: Stopwatch
    planned: int

    def at_end(self, loop: Loop) -> None:
        peak = peak_memory_mib()
        memory = "" if peak is None else f" and {in_gigabytes(int(peak * MEBIBYTE))} of memory"
        seconds = in_words(self.stopwatch.read()[0])
        self.reporter.say(f"took {seconds}{memory} (planned: up to {in_gigabytes(self.planned)})")


def run_to_the_end(
    loop: Loop,
    out: Path,
    session: SessionOptions,
    reporter: Reporter,
    should_stop: Ends,
    look: Look | None,
    planned: int,
    held_out: HeldOutScore = lambda: None,
) -> None:
    """Train to the end with progress, checkpoints and a log.

    Args:
        loop: the loop. The callbacks of this module are inserted before its existing observers.
        out: the run folder.
        session: options with the number of steps between two checkpoints.
        reporter: receives progress.
        should_stop: function that returns True to end the training.
        look: function that is called between steps, such as a viewer. None means that no function is called.
        planned: memory in bytes that the process may use.
        held_out: function that scores held-out views for the log.

    Raises:
        TrainingStopped: ``should_stop`` returned True; the state is saved.
    """
    log = RunLog(out)
    log.cut(loop.state.step)
    stopwatch = Stopwatch(*log.elapsed())
    stop = Stop(should_stop)
    with reporter.track("training", loop.total) as advance:
        progress = Progress(advance, log, stopwatch, held_out)
        checkpoints = Checkpoints(out, session, progress, stopwatch)
        viewing = [] if look is None else [Viewing(look, should_stop, stopwatch)]
        memory = MemoryLimit(MemoryBound(planned))
        resources = ResourceReport(reporter, stopwatch, planned)
        loop.observers = [progress, memory, checkpoints, *viewing, stop, resources, *loop.observers]
        advance(loop.done, seconds=stopwatch.read()[0])
        try:
            stop.check(loop)
            loop.run()
        except TrainingStopped:
            progress.read()
            checkpoints.save(loop)
            raise
        except KeyboardInterrupt:
            if loop.whole:
                checkpoints.save(loop)
            raise
    for observer in loop.observers:
        observer.at_end(loop)
