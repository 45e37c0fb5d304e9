"""The loop of a training with progress, checkpoints, a log and a clean stop. It knows no method."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import torch

from polarguide.core.options import SessionOptions
from polarguide.core.progress import Advance, Reporter
from polarguide.core.system import MemoryBound
from polarguide.runs.folder import RunLog, SavedState, save_checkpoint
from polarguide.runs.stopwatch import Stopwatch
from polarguide.training.distributed import Ranks
from polarguide.training.losses import refuse_diverged
from polarguide.training.settings import ResolvedSettings, StepReport

LOG_EVERY = 10
Ends = Callable[[], bool]
"""Returns true to end the training."""
Look = Callable[[Ends], None]
"""Runs between two steps, such as a viewer; its argument tells when the training should end."""


class LoopTrainer(Protocol):
    """Does the steps of a training."""

    @property
    def settings(self) -> ResolvedSettings:
        """The settings of the training."""

    @property
    def ranks(self) -> Ranks:
        """The processes that share the training."""

    @property
    def whole(self) -> bool:
        """True where the state is one between two steps."""

    @property
    def state(self) -> SavedState:
        """The state between two steps."""

    @property
    def total(self) -> int:
        """Number of steps in all, for progress."""

    @property
    def done(self) -> int:
        """Number of finished steps, for progress."""

    def step(self) -> StepReport:
        """Do one step."""

    def exchange_statistics(self) -> None:
        """Share statistics among all ranks before a checkpoint."""


class TrainingStopped(KeyboardInterrupt):
    """Training was asked to stop; its state is saved.

    Attributes:
        step: how many steps were done.
    """

    def __init__(self, step: int) -> None:
        super().__init__(f"stopped after step {step}")
        self.step = step


class TrainingLoop:
    """Trains to the end with progress, checkpoints and a log. Rank 0 alone writes.

    Args:
        trainer: does the steps. out: the run folder. session: how often the state is saved.
        reporter: receives progress. should_stop: asked between steps. look: called between steps; None: nothing.
        memory: gives freed memory back.
    """

    def __init__(
        self,
        trainer: LoopTrainer,
        out: Path,
        session: SessionOptions,
        reporter: Reporter,
        should_stop: Ends,
        look: Look | None,
        memory: MemoryBound,
    ) -> None:
        self._trainer = trainer
        self._out = out
        self._session = session
        self._memory = memory
        self._reporter = reporter
        self._should_stop = should_stop
        self._look = look
        self._log = RunLog(out) if trainer.ranks.rank == 0 else None
        if self._log is not None:
            self._log.cut(trainer.state.step)
        seconds, alone = self._log.elapsed() if self._log else (0.0, True)
        self._stopwatch = Stopwatch(seconds, alone)

    def run(self) -> float:
        """Train; see ``train``. Returns the seconds that it took."""
        trainer = self._trainer
        with self._reporter.track("training", trainer.total) as advance:
            meter = _Meter(advance, self._log, self._stopwatch)
            advance(trainer.done, seconds=self._stopwatch.read()[0])
            try:
                stopped = self._steps(meter)
            except KeyboardInterrupt:
                if trainer.ranks.world == 1 and trainer.whole:
                    self._save()
                raise
            meter.read()
        self._save()
        if stopped:
            raise TrainingStopped(trainer.state.step)
        return self._stopwatch.read()[0]

    def _steps(self, meter: _Meter) -> bool:
        """Steps up to the last one; True where training is to stop before."""
        trainer = self._trainer
        ranks = self._trainer.ranks
        while trainer.state.step < trainer.settings.steps:
            # Several ranks stop after the same step, so they have to ask each other, which takes time.
            if (ranks.world == 1 or trainer.state.step % LOG_EVERY == 0) and ranks.any(self._should_stop()):
                return True
            meter.take(trainer.step())
            self._memory.keep()
            if trainer.state.step % self._session.checkpoint_every == 0:
                with self._stopwatch.paused():
                    meter.read()
                    self._save()
            if self._look is not None:
                with self._stopwatch.paused():
                    self._look(self._should_stop)
        return False

    def _save(self) -> None:
        """A checkpoint of what all ranks have seen, by rank 0."""
        self._trainer.exchange_statistics()
        if self._trainer.ranks.rank == 0:
            state = self._trainer.state
            goes_on = state.step < self._trainer.settings.steps
            save_checkpoint(self._out, state, optimizer=goes_on or self._session.keep_optimizer)


class _Meter:
    """Smooths what the steps report, hands it on, and writes every tenth into the log.

    Reports are looked at ten at a time: on a GPU, looking waits for it.
    """

    def __init__(self, advance: Advance, log: RunLog | None, stopwatch: Stopwatch) -> None:
        self._advance = advance
        self._log = log
        self._stopwatch = stopwatch
        self._loss = self._psnr = math.nan
        self._began = stopwatch.read()[0]
        self._first = -1
        self._waiting: list[StepReport] = []

    def take(self, report: StepReport) -> None:
        """Take one step's report."""
        if self._first < 0:
            self._first = report.done - 1
        elif report.step == 0 and self._log is not None:
            self._log.cut(0)  # it has begun again
        self._waiting.append(report)
        if (report.step + 1) % LOG_EVERY == 0:
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
        """Look at the reports that wait; loss and PSNR of the last.

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
            keep = 0.0 if math.isnan(self._loss) else 0.98
            self._loss = loss if keep == 0 else keep * self._loss + (1 - keep) * loss
            self._psnr = psnr if keep == 0 else keep * self._psnr + (1 - keep) * psnr
        seconds, _ = self._stopwatch.read()
        rate = (last.done - self._first) / max(1e-9, seconds - self._began)
        count = "" if last.gaussians is None else f"{last.gaussians:,} Gaussians  "
        note = f"{last.stage}  loss {self._loss:.4f}  PSNR {self._psnr:.2f} dB  {count}{rate:.1f} it/s"
        self._advance(last.done, note=note, seconds=seconds)
        return loss, psnr
