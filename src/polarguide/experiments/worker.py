"""A child process of a comparison or a batch: does the task on standard input, as long as that is open."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from polarguide import __version__
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SessionOptions
from polarguide.core.records import decode
from polarguide.core.system import StopSignals, keep_freed_memory
from polarguide.experiments.capture_steps import process
from polarguide.experiments.collection import RUN, Processing
from polarguide.experiments.tasks import Message, Scoring, Task, files_digest
from polarguide.raster import use_threads
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.results.evaluation.record import code_digest
from polarguide.runs.folder import CONFIGURATION, writing_to
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import train

STDIN = 0
PATIENCE_SECONDS = 120.0
"""How long to wait for a process that has lost its worker: it still saves the state that this one goes on from."""


def main() -> int:
    """Do the task on standard input, and stop where that ends; returns the exit status that ``obey`` gives."""
    # SIGTERM acts as Ctrl-C does, so that whatever is open is closed; a shell's background jobs ignore Ctrl-C.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.default_int_handler)
    keep_freed_memory()
    try:
        line = _read_line()
        if not line.endswith(b"\n"):  # nobody has sent a whole one
            return obey(line)
        threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
        return obey(line)
    except KeyboardInterrupt:
        return 130


def _read_line() -> bytes:
    """A line of standard input. Unbuffered: a thread that waits for more would hold the buffer at the process's end."""
    data = b""
    while not data.endswith(b"\n") and (more := os.read(STDIN, 1 << 16)):
        data += more
    return data


def _stop_at_end_of_input() -> None:
    """Interrupt the main thread when nobody holds the other end of standard input any more.

    That is how a worker asks to stop, and what happens when it is killed: no child goes on unwatched.
    """
    while os.read(STDIN, 1 << 16):
        pass
    _thread.interrupt_main()


def obey(line: bytes) -> int:
    """Do a task; returns the exit status (0 done, 130 stopped, 2 wrong input, with one line)."""
    try:
        message: Any = decode(line, Message, "task")
        check_code(message)
        do(message.task)
    except PolarguideError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        print(f"{error.filename or 'files'}: {error.strerror or error}.", file=sys.stderr)
        return 2
    return 0


def check_code(message: Message) -> None:
    """Refuse to compute with other code than that of the command: results would be mixed. Comments do not count.

    Raises:
        PolarguideError: this installation differs.
    """
    if message.files != files_digest() and message.code != code_digest():
        raise PolarguideError(
            "worker",
            expected=f"the code of the command (digest {message.code})",
            found=f"polarguide {__version__} with digest {code_digest()} in {Path(__file__).parents[1]}",
            remedy="Install the same version on all machines, and leave it as it is while the command works.",
        )


def do(task: Task) -> None:
    """Train, score, or process a capture.

    Raises:
        PolarguideError: the input is wrong, or the training has diverged.
        KeyboardInterrupt: stopped; a training has saved its state.
    """
    use_threads(task.compute.threads)
    if isinstance(task, Processing):
        _wait_for_others(Path(task.folder) / RUN)
        process(task)
        return
    if isinstance(task, Scoring):
        evaluate(OpenedRun.open(task.folder, device=task.compute.device), speed=task.speed)
        return
    _wait_for_others(Path(task.folder))
    with StopSignals() as should_stop:
        train(
            task.scene,
            task.folder,
            recipe=task.recipe,
            settings=task.settings,
            session=SessionOptions(task.compute.threads, task.compute.device),
            reading=task.reading,
            resume=(Path(task.folder) / CONFIGURATION).exists(),
            should_stop=should_stop,
        )


def _wait_for_others(run: Path) -> None:
    """Wait until nobody writes to a run.

    Raises:
        PolarguideError: another training does not end.
    """
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            with writing_to(run):
                return
        except PolarguideError:
            if time.monotonic() > end:
                raise
        time.sleep(0.2)
