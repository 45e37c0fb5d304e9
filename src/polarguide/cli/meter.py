"""What a training shows while it runs, and what it writes into its log."""

from __future__ import annotations

import math
import time

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from polarguide.cli.common import console
from polarguide.runs.folder import RunLog
from polarguide.training.losses import refuse_diverged
from polarguide.training.settings import StepReport
from polarguide.training.stopwatch import Stopwatch

LOG_EVERY = 10


def progress_bar() -> Progress:
    """The bar of a training, with its time left."""
    return Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
        console=console,
    )


class Meter:
    """Smooths what the steps report, shows it, and writes every tenth into the log.

    Reports are looked at ten at a time: on a GPU, looking waits for it.
    """

    def __init__(self, progress: Progress, task: TaskID, log: RunLog | None, stopwatch: Stopwatch) -> None:
        self._progress, self._task, self._log, self._stopwatch = progress, task, log, stopwatch
        self._loss = self._psnr = math.nan
        self._began, self._first = time.perf_counter(), -1
        self._waiting: list[StepReport] = []

    def show(self, report: StepReport) -> None:
        """Take one step's report."""
        if self._first < 0:
            self._first = report.step
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
        rate = (last.step + 1 - self._first) / max(1e-9, time.perf_counter() - self._began)
        note = (
            f"{last.stage}  loss {self._loss:.4f}  PSNR {self._psnr:.2f} dB  "
            f"{last.gaussians:,} Gaussians  {rate:.1f} it/s"
        )
        self._progress.update(self._task, completed=last.step + 1, note=note)
        return loss, psnr
