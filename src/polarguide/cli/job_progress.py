"""One progress display for many trainings: a bar for all with the time left, and a line for each at work."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from polarguide.cli.common import console
from polarguide.experiments.jobs import Child, Job
from polarguide.runs.folder import LOG

TAIL_BYTES = 4096
# Trainings log every tenth step and recipes differ in speed: a long memory keeps the time left from jumping.
MEMORY_SECONDS = 300.0


class JobProgress:
    """The display; use it as a context.

    Args:
        jobs: all jobs that are to be done.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._steps = {job.folder: _step(job) for job in jobs}
        self._total, self._ended = len(jobs), 0
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=console,
            speed_estimate_period=MEMORY_SECONDS,
        )
        self._all = self._progress.add_task(
            "all", total=sum(job.steps for job in jobs), completed=sum(self._steps.values()), note=""
        )
        self._tasks: dict[Path, TaskID] = {}

    def __enter__(self) -> JobProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def look(self, active: Sequence[Child]) -> None:
        """Show where the jobs at work are."""
        for child in active:
            job = child.job
            if job.folder not in self._tasks:
                self._tasks[job.folder] = self._progress.add_task(escape(job.label), total=job.steps, note="")
            line = last_line(job.folder / LOG) or {}
            self._steps[job.folder] = _step(job)
            psnr, count = line.get("psnr"), line.get("gaussians")
            note = "scoring" if child.verb == "eval" else ""
            if not note and psnr is not None and count is not None:
                note = f"PSNR {psnr:.1f} dB  {count:,} Gaussians"
            self._progress.update(self._tasks[job.folder], completed=self._steps[job.folder], note=note)
        done = f"{self._ended}/{self._total} runs"
        self._progress.update(self._all, completed=sum(self._steps.values()), note=done)

    def ended(self, job: Job, error: str | None) -> None:
        """Take a job off the display and leave a line about it."""
        self._ended += 1
        self._steps[job.folder] = job.steps
        task = self._tasks.pop(job.folder, None)
        if task is not None:
            self._progress.remove_task(task)
        mark, tail = ("[green]done[/]", "") if error is None else ("[bold red]failed[/]", f": {error}")
        self._progress.console.print(f"{mark}  {escape(job.label + tail)}")


def last_line(log: Path) -> dict[str, Any] | None:
    """The last whole line of a log, or None where there is none yet."""
    try:
        with open(log, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read().split(b"\n")
    except OSError:
        return None
    for line in reversed(lines):
        try:
            values = json.loads(line)
        except ValueError:  # empty, half written, or cut by the seek
            continue
        if isinstance(values, dict):
            return values
    return None


def _step(job: Job) -> int:
    line = last_line(job.folder / LOG)
    return min(job.steps, int(line["step"]) + 1) if line and "step" in line else 0
