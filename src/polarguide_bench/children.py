"""Tasks of a comparison or a batch, each in a child process that a worker of dask watches.

A worker imports this module and none that imports torch. It computes nothing itself: it answers its scheduler at all
times, and a child's memory, threads and signals are its own.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import msgspec

from polarguide.core.files import make_folder
from polarguide.core.options import ComputeOptions, SceneOptions
from polarguide.training.settings import TrainSettings
from polarguide_bench.collection import Processing

SOURCES = Path(__file__).parents[1]
"""The folder of all packages."""
PACKAGES = ("polarguide", "polarguide_shots", "polarguide_synth", "polarguide_bench")
PROLOGUE = (
    "import gc, sys; gc.disable(); "  # while names are imported, which stay: a fifth of the seconds
    "sys.path[:] = [path for path in sys.path if path]; "  # what is empty is the current folder
    "sys.path[:0] = [path for path in sys.argv[1:] if path not in sys.path]; "
    "from polarguide_bench.worker import main; gc.enable(); sys.exit(main())"
)
"""What a child runs: it imports this package from where it is here, and nothing from the current folder."""
COMMAND = (sys.executable, "-c", PROLOGUE, str(SOURCES))


@cache
def files_digest() -> str:
    """Sixteen hexadecimal digits that change with any byte of the code of all packages."""
    digest = hashlib.sha256()
    kinds = ("**/*.py", "_native.*.so", "_native.*.pyd")
    for path in sorted(path for name in PACKAGES for kind in kinds for path in (SOURCES / name).glob(kind)):
        digest.update(f"{path.relative_to(SOURCES).as_posix()} {path.stat().st_size}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="train"):
    """Train a run, or go on with the one in its folder."""

    scene: str
    folder: str
    recipe: str
    settings: TrainSettings
    reading: SceneOptions
    compute: ComputeOptions


class Scoring(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="score"):
    """Score a finished run; with ``speed`` also time its pictures."""

    folder: str
    speed: bool
    compute: ComputeOptions


Task = Training | Scoring | Processing


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The line that a child process reads: its task, and a digest of the code of the process that sends it.

    Attributes:
        files: its ``files_digest``. code: its ``code_digest``, which takes seconds, and counts where ``files`` differs.
    """

    task: Task
    files: str
    code: str

    def to_line(self) -> bytes:
        """The line; names of files that are no Unicode are escapes in it."""
        return json.dumps(msgspec.to_builtins(self)).encode() + b"\n"


class Outcome(msgspec.Struct, frozen=True):
    """The outcome of a job on a worker.

    Attributes:
        state: "done"; "failed", with the last line of its ``stderr.txt``; "lost", when it was ended from outside, so
            that it can go on elsewhere.
        error: that line, or how it ended.
    """

    state: Literal["done", "failed", "lost"]
    error: str = ""


POLL_SECONDS = 0.1
STDERR = "stderr.txt"
STOPPED = 130
"""Exit status of a child that was asked to stop."""
FROM_OUTSIDE = tuple(-number for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)))
"""Exit statuses of a child that somebody ended: the system for want of memory, a user, the manager of a cluster."""

_at_work: dict[str, subprocess.Popen[bytes]] = {}


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
        gpus: GPUs of the workers of this machine, who are called 0, 1, ... and take one each, in turn.
    """
    from distributed import get_worker
    from distributed.worker import thread_state

    worker = get_worker()
    key = thread_state.key
    device = {"CUDA_VISIBLE_DEVICES": gpus[int(worker.name) % len(gpus)]} if gpus else {}

    def wanted() -> bool:
        """Return False if the task was canceled or its command has ended."""
        state = worker.state.tasks.get(key)
        return state is not None and state.state != "cancelled"

    for message in messages:
        try:
            outcome = _watched(message, Path(folder), device, key, wanted)
        except OSError as error:  # no room, no rights, no processes: of this machine, perhaps
            return Outcome("failed", f"{error.filename or folder}: {error.strerror or error}")
        if outcome.state != "done":
            return outcome
    return Outcome("done")


def _watched(
    message: Message, folder: Path, device: dict[str, str], key: str, wanted: Callable[[], bool]
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
    _at_work[key] = process
    try:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(message.to_line())
            process.stdin.flush()
        while process.poll() is None:
            if not wanted():
                with contextlib.suppress(OSError):
                    process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(POLL_SECONDS)
    finally:
        del _at_work[key]
        with contextlib.suppress(OSError):
            process.stdin.close()  # which ends it, if anything happens here
    status = process.returncode
    if status == 0:
        return Outcome("done")
    lines = [line for line in errors.read_text(errors="replace").splitlines() if line.strip()]
    text = lines[-1].strip() if lines else f"the process ended with status {status}"
    return Outcome("lost" if status == STOPPED or status in FROM_OUTSIDE else "failed", text)


def _processes(keys: Sequence[str]) -> list[subprocess.Popen[bytes]]:
    return [process for process in map(_at_work.get, keys) if process is not None]


def count_at_work(keys: Sequence[str]) -> int:
    """How many of the tasks still have a process on this worker."""
    return len(_processes(keys))


def kill(keys: Sequence[str]) -> None:
    """End the processes of tasks at once; their last checkpoints stay."""
    for process in _processes(keys):
        process.kill()
