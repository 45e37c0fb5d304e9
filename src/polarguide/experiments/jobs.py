"""Child processes, several at a time: started, watched, and stopped without loss."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from polarguide.core.files import make_folder
from polarguide.core.progress import Advance, Reporter
from polarguide.experiments.worker import COMMAND, Task, Training, encoded
from polarguide.runs.folder import LOG

POLL_SECONDS = 0.1
STDERR = "stderr.txt"
TAIL_BYTES = 4096


@dataclass(frozen=True)
class Job:
    """Tasks to do one after the other, each in a process of its own.

    Attributes:
        label: what messages call it.
        folder: of the run; made if need be. Its ``stderr.txt`` takes what the children write.
        tasks: what to do.
        steps: the number of training steps at its end.
    """

    label: str
    folder: Path
    tasks: tuple[Task, ...]
    steps: int

    def step(self) -> int:
        """How many steps of the training are done, as its log says."""
        row = last_row(self.folder / LOG)
        return 0 if row is None else min(self.steps, row.step + 1)


class Child:
    """A job at work."""

    def __init__(self, job: Job, advance: Advance, command: Sequence[str]) -> None:
        self.job, self._advance, self._command = job, advance, command
        self._waiting = deque(job.tasks)
        make_folder(job.folder)
        self._errors = job.folder / STDERR
        self._start_next()

    def _start_next(self) -> None:
        self._task = self._waiting.popleft()
        self._errors.unlink(missing_ok=True)  # a link or a pipe, perhaps, in a folder that somebody else made
        with open(self._errors, "xb") as errors:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env={
                    "OMP_WAIT_POLICY": "PASSIVE",
                    **os.environ,
                    "OMP_NUM_THREADS": str(self._task.compute.threads),
                },
                # A session of its own: Ctrl-C in the terminal reaches it through the parent alone, once. The lock of
                # the output folder, which it inherits, outlives a parent that is killed.
                start_new_session=True,
                close_fds=False,
            )
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError), self._process.stdin as stdin:
            stdin.write(encoded(self._task))

    def ended(self) -> bool:
        """Poll the process, start the next one if it succeeded; True where nothing is left to do."""
        code = self._process.poll()
        if code is None:
            return False
        if code == 0 and self._waiting:
            self._start_next()
            return False
        return True

    def error(self) -> str | None:
        """After the end: the last line of its stderr, or None if all went well."""
        if self._process.returncode == 0:
            return None
        lines = [line for line in self._errors.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else f"the process ended with status {self._process.returncode}"

    def report(self) -> None:
        """Pass on how far it is."""
        note = "" if isinstance(self._task, Training) else "scoring"
        row = last_row(self.job.folder / LOG)
        if not note and row is not None and row.psnr is not None:
            count = "" if row.gaussians is None else f"  {row.gaussians:,} Gaussians"
            note = f"PSNR {row.psnr:.1f} dB{count}"
        self._advance(self.job.step(), note=note)

    def interrupt(self) -> None:
        """Ask it to stop: a training saves its state first."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def wait(self) -> None:
        """Until it has stopped."""
        # With a time limit it polls: a second Ctrl-C that the system hands to another thread is noticed, too.
        self._process.wait(timeout=1e9)

    def kill(self) -> None:
        """Stop it at once; its last checkpoint stays."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()


class _Progress:
    """Progress of many jobs: one bar for all, and one for each running job."""

    def __init__(self, jobs: Sequence[Job], reporter: Reporter, stack: contextlib.ExitStack) -> None:
        self._reporter, self._total, self._ended = reporter, len(jobs), 0
        self._steps = {job.folder: job.step() for job in jobs}
        self._all = stack.enter_context(reporter.track("all", sum(job.steps for job in jobs)))
        self._stack = stack
        self._open: dict[Path, contextlib.ExitStack] = {}

    def begin(self, job: Job) -> Advance:
        """A job starts."""
        self._open[job.folder] = self._stack.enter_context(contextlib.ExitStack())
        return self._open[job.folder].enter_context(self._reporter.track(job.label, job.steps))

    def report(self, active: Sequence[Child]) -> None:
        """How far all and each of them are."""
        for child in active:
            child.report()
            self._steps[child.job.folder] = child.job.step()
        self._all(sum(self._steps.values()), note=f"{self._ended}/{self._total} runs")

    def end(self, job: Job, error: str | None) -> None:
        """A job has ended."""
        self._ended += 1
        self._steps[job.folder] = job.steps
        self._open.pop(job.folder).close()
        self._reporter.say(f"done  {job.label}" if error is None else f"failed  {job.label}: {error}")


def run_jobs(
    jobs: Sequence[Job],
    *,
    parallel: int,
    reporter: Reporter,
    on_end: Callable[[Job, str | None], None] = lambda job, error: None,
    command: Sequence[str] = COMMAND,
) -> None:
    """Work through jobs. One that fails takes no other down.

    Args:
        jobs: what to do, in this order.
        parallel: jobs at a time.
        reporter: receives progress, and a line at the end of each job.
        on_end: called after each job, with its error or None.
        command: what to run in a child, with the task on its standard input.

    Raises:
        KeyboardInterrupt: raised meanwhile, as by Ctrl-C; passed on when all children have stopped.
    """
    waiting, active = deque(jobs), list[Child]()
    with contextlib.ExitStack() as stack:
        progress = _Progress(jobs, reporter, stack)
        try:
            while waiting or active:
                while waiting and len(active) < parallel:
                    job = waiting.popleft()
                    active.append(Child(job, progress.begin(job), command))
                for child in [child for child in active if child.ended()]:
                    active.remove(child)
                    error = child.error()
                    progress.end(child.job, error)
                    on_end(child.job, error)
                progress.report(active)
                time.sleep(POLL_SECONDS)
        except BaseException:  # whatever happens here, no child goes on unwatched
            _stop(active)
            raise


def _stop(children: Sequence[Child]) -> None:
    """Interrupt all, wait for all; a second Ctrl-C kills them."""
    try:
        for child in children:
            child.interrupt()
        for child in children:
            child.wait()
    except KeyboardInterrupt:
        for child in children:
            child.kill()


class LogRow(msgspec.Struct):
    """A line of a log, as far as progress shows it."""

    step: Annotated[int, msgspec.Meta(ge=0)]
    psnr: float | None = None
    gaussians: int | None = None


_ROWS = msgspec.json.Decoder(LogRow)


def last_row(log: Path) -> LogRow | None:
    """The last whole line of a log, or None where there is none yet."""
    try:
        if not log.is_file():  # a pipe would never end
            return None
        with open(log, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read(TAIL_BYTES).split(b"\n")
    except OSError:
        return None
    for line in reversed(lines):
        with contextlib.suppress(ValueError, RecursionError):  # empty, half written, or cut by the seek
            return _ROWS.decode(line)
    return None
