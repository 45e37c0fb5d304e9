"""What a worker of dask does: the tasks of a job, each in a child process that is watched.

A worker imports this module and none that imports torch. It computes nothing itself: it answers its scheduler at all
times, and a child's memory, threads and signals are its own.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from polarguide.core.files import make_folder
from polarguide.experiments.tasks import COMMAND, Message, Outcome, encoded

if TYPE_CHECKING:
    from distributed import Worker

POLL_SECONDS = 0.1
STDERR = "stderr.txt"
STOPPED = 130
"""Exit status of a child that was asked to stop."""
FROM_OUTSIDE = tuple(-number for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)))
"""Exit statuses of a child that somebody ended: the system for want of memory, a user, the manager of a cluster."""

_at_work: dict[str, subprocess.Popen[bytes]] = {}
_lock = threading.Lock()


def perform(
    messages: Sequence[Message],
    folder: str,
    *,
    gpus: Sequence[str] = (),
) -> Outcome:
    """Do tasks one after the other, on a worker of dask; stop where its task is canceled.

    Args:
        messages: the tasks, each is done in a process of its own.
        folder: made if need be. Its ``stderr.txt`` takes what the children write.
        gpus: of the workers of this machine, who are called 0, 1, ... and take one each, in turn.
    """
    from distributed import get_worker
    from distributed.worker import thread_state

    worker, key = get_worker(), thread_state.key
    device = {"CUDA_VISIBLE_DEVICES": gpus[int(worker.name) % len(gpus)]} if gpus else {}
    for message in messages:
        try:
            outcome = _watched(message, Path(folder), device, key, lambda: _wanted(worker, key))
        except OSError as error:  # no room, no rights, no processes: of this machine, perhaps
            return Outcome("failed", f"{error.filename or folder}: {error.strerror or error}")
        if outcome.state != "done":
            return outcome
    return Outcome("done")


def _wanted(worker: Worker, key: object) -> bool:
    """Whether somebody waits for a task: not if it was canceled, nor if the command that asked for it is gone."""
    state = worker.state.tasks.get(key)  # type: ignore[call-overload]
    return state is not None and state.state != "cancelled"


def _watched(
    message: Message,
    folder: Path,
    device: dict[str, str],
    key: str,
    wanted: Callable[[], bool],
) -> Outcome:
    """One task from its begin to its end."""
    make_folder(folder)
    errors = folder / STDERR
    errors.unlink(missing_ok=True)  # a link or a pipe, perhaps, in a folder that somebody else made
    with open(errors, "xb") as file:
        process = subprocess.Popen(
            COMMAND,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=file,
            env={
                "OMP_WAIT_POLICY": "PASSIVE",
                **os.environ,
                "OMP_NUM_THREADS": str(message.task.compute.threads),
                **device,
            },
            # A session of its own: Ctrl-C in the terminal reaches it through its worker alone, once. The lock of the
            # output folder, which children of the command itself inherit, outlives a command that is killed.
            start_new_session=True,
            close_fds=False,
        )
    assert process.stdin is not None
    with _lock:
        _at_work[key] = process
    try:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(encoded(message))
            process.stdin.flush()
        while process.poll() is None:
            if not wanted():
                with contextlib.suppress(OSError):
                    process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(POLL_SECONDS)
    finally:
        with _lock:
            del _at_work[key]
        with contextlib.suppress(OSError):
            process.stdin.close()  # which ends it, if anything happens here
    return _outcome(process.returncode, errors)


def _outcome(status: int, errors: Path) -> Outcome:
    if status == 0:
        return Outcome("done")
    lines = [line for line in errors.read_text(errors="replace").splitlines() if line.strip()]
    text = lines[-1].strip() if lines else f"the process ended with status {status}"
    lost = status == STOPPED or status in FROM_OUTSIDE
    return Outcome("lost" if lost else "failed", text)


def count_at_work(keys: Sequence[str]) -> int:
    """How many of the tasks still have a process on this worker."""
    with _lock:
        return len(_at_work.keys() & set(keys))


def kill(keys: Sequence[str]) -> None:
    """End the processes of tasks at once; their last checkpoints stay."""
    with _lock:
        for key in _at_work.keys() & set(keys):
            _at_work[key].kill()
