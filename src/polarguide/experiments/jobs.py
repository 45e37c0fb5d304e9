"""Child processes, several at a time: started, watched, and stopped without loss."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

PROGRAM = (sys.executable, "-m", "polarguide")
POLL_SECONDS = 0.1
STDERR = "stderr.txt"


@dataclass(frozen=True)
class Job:
    """Command lines of the program (without its name) to run one after the other.

    Attributes:
        label: what messages call it.
        folder: of the run; made if need be. Its ``stderr.txt`` takes what the children say.
        commands: the command lines.
        steps: the number of training steps at its end.
    """

    label: str
    folder: Path
    commands: tuple[tuple[str, ...], ...]
    steps: int


class Child:
    """A job at work."""

    def __init__(self, job: Job, threads: int) -> None:
        self.job, self._threads = job, threads
        self._waiting = deque(job.commands)
        job.folder.mkdir(parents=True, exist_ok=True)
        self._errors = job.folder / STDERR
        self._process: subprocess.Popen[bytes] | None = None
        self.verb = ""
        self._next()

    def _next(self) -> None:
        command = self._waiting.popleft()
        self.verb = command[0]
        count = str(self._threads)
        with open(self._errors, "wb") as errors:
            self._process = subprocess.Popen(
                [*PROGRAM, *command, "--threads", count],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env={**os.environ, "OMP_NUM_THREADS": count},
                # A session of its own: Ctrl-C in the terminal reaches it through the parent alone, once. The lock of
                # the output folder, which it inherits, outlives a parent that is killed.
                start_new_session=True,
                close_fds=False,
            )

    def ended(self) -> bool:
        """Look at the process, start the next one if it succeeded; True where nothing is left to do."""
        assert self._process is not None
        code = self._process.poll()
        if code is None:
            return False
        if code == 0 and self._waiting:
            self._next()
            return False
        return True

    def error(self) -> str | None:
        """After the end: the last line of its stderr, or None if all went well."""
        assert self._process is not None
        if self._process.returncode == 0:
            return None
        lines = [line for line in self._errors.read_text(errors="replace").splitlines() if line.strip()]
        said = lines[-1].strip() if lines else f"{self.verb} ended with status {self._process.returncode}"
        return said.removeprefix("error: ")

    def interrupt(self) -> None:
        """Ask it to stop: a training saves its state first."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def wait(self) -> None:
        """Until it has stopped."""
        if self._process is not None:
            self._process.wait()

    def kill(self) -> None:
        """Stop it at once; its last checkpoint stays."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()


def run_jobs(
    jobs: Sequence[Job],
    *,
    parallel: int,
    threads: int,
    on_end: Callable[[Job, str | None], None],
    on_look: Callable[[Sequence[Child]], None],
) -> None:
    """Work through jobs. One that fails takes no other down.

    Args:
        jobs: what to do, in this order.
        parallel: jobs at a time. threads: of each.
        on_end: called after each job, with its error or None.
        on_look: called several times a second with the jobs at work.

    Raises:
        KeyboardInterrupt: after Ctrl-C, SIGTERM or SIGHUP, when all children have stopped.
    """
    waiting, active = deque(jobs), list[Child]()
    with _signals_as_interrupts():
        try:
            while waiting or active:
                while waiting and len(active) < parallel:
                    active.append(Child(waiting.popleft(), threads))
                for child in [child for child in active if child.ended()]:
                    active.remove(child)
                    on_end(child.job, child.error())
                on_look(active)
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


@contextlib.contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """SIGTERM and SIGHUP act like Ctrl-C."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    old = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
