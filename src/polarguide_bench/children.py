"""Tasks of comparisons and batches, and child processes that perform the tasks on workers of dask.

Workers and the command line import this module, so it does not import torch. A worker does no computation itself, so it
always answers its scheduler. Each child has its own memory, threads and signals.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec

from polarguide.core.errors import require
from polarguide.core.files import make_folder, write_whole
from polarguide.core.options import ComputeOptions, ExportFormat, SceneOptions
from polarguide.core.records import read_record, to_json
from polarguide.core.text import canonical
from polarguide.preparation.settings import PrepareSettings
from polarguide.training.settings import TrainSettings

FORMAT = 1
"""Version of the format of a capture's record."""
RECORD = "capture.json"
"""Name of the record's file in the folder of a capture."""
INSPECTION = "inspection"
"""Name of the inspection's folder in the folder of a capture."""
RUN = "run"
"""Name of the run folder in the folder of a capture."""
SHARE = "share.html"
"""Name of the shared web page in the folder of a capture."""
Step = Literal["prepare", "inspect", "train", "eval", "share", "export"]
STEPS: tuple[Step, ...] = ("prepare", "inspect", "train", "eval", "share", "export")
"""Processing steps of a capture, in order."""
NO_FILES = (0, 0, 0)
"""Stamp (number, size, newest time) of an empty or missing folder."""


@dataclass(frozen=True)
class Capture:
    """Capture of a collection, with the options of its processing.

    Attributes:
        name: name of the capture's folder in the results.
        path: folder with the files of the capture, or a scene folder.
        prepare: settings of the preparation, which a scene does not need.
        recipes: recipes, each of which trains on the capture.
        settings: settings of the training.
        reading: options for reading the scene.
    """

    name: str
    path: Path
    prepare: PrepareSettings = field(default_factory=PrepareSettings)
    recipes: tuple[str, ...] = ("polarguide-stokes",)
    settings: TrainSettings = TrainSettings()
    reading: SceneOptions = SceneOptions()


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All inputs that determine the results of a capture. If they change, the results are outdated.

    Attributes:
        source: absolute path of the capture's folder.
        stamp: number, total size and newest modification time of its files.
        prepare: result of ``PrepareSettings.record()``, or None if the source is a scene.
        recipe: recipe of the training.
        settings: settings of the training.
        reading: options for reading the scene.
        formats: formats of the export.
        digest: SHA-256 of the names and contents of the files. It shows that files with a new stamp are unchanged.
            Records of earlier versions have an empty digest.
    """

    source: str
    stamp: tuple[int, int, int]
    prepare: dict[str, Any] | None
    recipe: str
    settings: TrainSettings
    reading: SceneOptions
    formats: tuple[ExportFormat, ...]
    digest: str = ""


class CaptureRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Progress and results of a capture.

    Attributes:
        format: version of the record.
        request: inputs of the capture.
        done: steps that are finished.
        at: last step that was started.
        verdict: verdict of the inspection.
        findings: findings of the inspection that describe a problem.
        pictures: pictures of one view, each with a label and a data URI.
        files: exported files, relative to the capture's folder.
    """

    format: int
    request: Request
    done: tuple[Step, ...] = ()
    at: Step | None = None
    verdict: str = ""
    findings: tuple[str, ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()
    files: tuple[str, ...] = ()

    def save(self, folder: Path) -> None:
        """Write the record atomically."""
        write_whole(folder / RECORD, to_json(msgspec.to_builtins(self)))

    @staticmethod
    def load(folder: Path) -> CaptureRecord | None:
        """Read the record in a folder. Return None if the folder has no record.

        Raises:
            PolarguideError: the file is not a valid record.
        """
        if not os.path.lexists(folder / RECORD):
            return None
        return read_record(folder / RECORD, CaptureRecord, remedy="Remove the folder to begin again.")

    def require(self, request: Request, folder: Path) -> None:
        """Check that the capture was started with the same request.

        The source of a finished capture may be deleted.

        Raises:
            PolarguideError: the requests differ.
        """
        if request.stamp == NO_FILES and set(self.done) == set(STEPS):
            return
        ignored = {"source", "digest"}  # the content identifies files, not their location
        if self.request.digest == request.digest != "":
            ignored.add("stamp")
        for name in Request.__struct_fields__:
            require(
                name in ignored or getattr(self.request, name) == getattr(request, name),
                folder,
                expected=f"the capture and options of the first start ({name})",
                found="changed files" if name == "stamp" else "other values",
                remedy="Remove this folder to begin again, or give another --out.",
            )


def prepare_settings(record: dict[str, Any]) -> PrepareSettings:
    """Convert the record of ``PrepareSettings.record()`` back to settings."""
    return msgspec.convert(
        record,
        PrepareSettings,
        strict=False,
        dec_hook=lambda kind, value: kind(value) if kind is Path else value,
    )


def source_stamp(folder: Path) -> tuple[int, int, int]:
    """Return the number of files below a folder, their total size in bytes, and the newest modification time in ns.

    Hidden files do not count.
    """
    states = []
    for path in _files_below(folder):
        with contextlib.suppress(OSError, ValueError):  # removed in the meantime, or an invalid name
            states.append(os.stat(path))
    sizes = sum(state.st_size for state in states)
    return len(states), sizes, max((state.st_mtime_ns for state in states), default=0)


def source_digest(folder: Path, earlier: Request | None, stamp: tuple[int, int, int]) -> str:
    """Return the SHA-256 of the names and contents of the files below a folder, or an empty text without files.

    Hidden files do not count.

    Args:
        folder: folder of the capture.
        earlier: request of an earlier call, if any. Its digest is reused if its stamp equals the current stamp.
        stamp: current stamp of the folder.
    """
    if earlier is not None and earlier.stamp == stamp and earlier.digest:
        return earlier.digest
    digest = hashlib.sha256()
    for path in filter(os.path.isfile, sorted(_files_below(folder))):  # reading a pipe may never end
        with contextlib.suppress(OSError), open(path, "rb") as file:
            digest.update(f"{canonical(os.path.relpath(path, folder))}\0".encode("utf-8", "surrogateescape"))
            while block := file.read(1 << 20):
                digest.update(block)
    return "" if stamp == NO_FILES else digest.hexdigest()


def _files_below(folder: Path) -> Iterator[str]:
    for at, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (os.path.join(at, name) for name in names if not name.startswith("."))


SOURCES = Path(__file__).parents[1]
"""Folder that contains all packages of this project."""
PACKAGES = ("polarguide", "polarguide_shots", "polarguide_synth", "polarguide_bench")
PROLOGUE = (
    "import gc, sys; gc.disable(); "  # imported names stay: a fifth of the time is saved
    "sys.path[:] = [path for path in sys.path if path]; "  # an empty path is the current folder
    "sys.path[:0] = [path for path in sys.argv[1:] if path not in sys.path]; "
    "from polarguide_bench.worker import main; gc.enable(); sys.exit(main())"
)
"""Program that a child runs. It imports this installation of the package, but no module from the current folder."""
COMMAND = (sys.executable, "-c", PROLOGUE, str(SOURCES))
"""Command line of a child."""


@cache
def files_digest() -> str:
    """Return a digest of the source files of all packages, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    kinds = ("**/*.py", "_native.*.so", "_native.*.pyd")
    for path in sorted(path for name in PACKAGES for kind in kinds for path in (SOURCES / name).glob(kind)):
        digest.update(f"{path.relative_to(SOURCES).as_posix()} {path.stat().st_size}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="train"):
    """Task that trains a run, or resumes the run in its folder."""

    scene: str
    folder: str
    recipe: str
    settings: TrainSettings
    reading: SceneOptions
    compute: ComputeOptions


class Scoring(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="score"):
    """Task that scores a finished run. With ``speed`` it also measures the rendering speed."""

    folder: str
    speed: bool
    compute: ComputeOptions


class Processing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="process"):
    """Task that performs the remaining steps of a capture with one recipe.

    Attributes:
        name: name of the capture.
        folder: folder of the results.
        request: inputs of the capture.
        compute: device and threads.
        first: folder of the task of the same capture that prepares and inspects the scene. It is empty for this task.
    """

    name: str
    folder: str
    request: Request
    compute: ComputeOptions
    first: str = ""


Task = Training | Scoring | Processing


class Definitions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Recipes and metrics of a user, which no package provides.

    Attributes:
        path: folders in which the sender looks for modules.
        data: the pickled recipes and metrics.
    """

    path: tuple[str, ...]
    data: bytes


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Message to a child: a task, and digests by which the child checks that it runs the same code.

    Attributes:
        task: the task.
        files: ``files_digest`` of the sender.
        code: ``code_digest`` of the sender. Its computation takes seconds, so it is compared only if ``files`` differs.
        definitions: recipes and metrics that the sender has registered, if any.
    """

    task: Task
    files: str
    code: str
    definitions: Definitions | None = None

    def to_line(self) -> bytes:
        """Return the message as one line of JSON. File names that are not valid Unicode are escaped."""
        return json.dumps(msgspec.to_builtins(self)).encode() + b"\n"


class Outcome(msgspec.Struct, frozen=True):
    """Result of a job on a worker.

    Attributes:
        state: "done", "failed" or "lost". A job is lost if its child was killed. It can resume on another worker.
        error: last line of ``stderr.txt``, or the exit status if this file is empty.
    """

    state: Literal["done", "failed", "lost"]
    error: str = ""


POLL_SECONDS = 0.1
"""Interval between checks of a child, in seconds."""
STDERR = "stderr.txt"
STOPPED = 130
"""Exit status of a child that has stopped on request."""
KILLED = tuple(-number for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)))
"""Exit statuses of a killed child. The system kills it for lack of memory; users and cluster managers may, too."""

_children: dict[str, subprocess.Popen[bytes]] = {}


def perform(
    messages: Sequence[Message],
    folder: str,
    *,
    gpus: Sequence[str] = (),
) -> Outcome:
    """Perform tasks one after the other on a worker of dask, until all are done or dask cancels the job.

    Args:
        messages: messages with the tasks. Each task has its own child process.
        folder: folder for the ``stderr.txt`` of the children, created if missing.
        gpus: GPUs of this machine. Workers are named 0, 1, ... and use the GPU at this index, modulo their number.
    """
    from distributed import get_worker
    from distributed.worker import thread_state

    worker = get_worker()
    key = thread_state.key
    device = {"CUDA_VISIBLE_DEVICES": gpus[int(worker.name) % len(gpus)]} if gpus else {}

    def requested() -> bool:
        """Return True unless the job was canceled or the command that submitted it has ended."""
        state = worker.state.tasks.get(key)
        return state is not None and state.state != "cancelled"

    outcome = Outcome("done")
    for message in messages:
        try:
            outcome = _run_child(message, Path(folder), device, key, requested)
        except OSError as error:  # full disk, missing permissions, no more processes
            outcome = Outcome("failed", f"{error.filename or folder}: {error.strerror or error}")
        if outcome.state != "done":
            break
    return outcome


def _run_child(
    message: Message, folder: Path, device: dict[str, str], key: str, requested: Callable[[], bool]
) -> Outcome:
    make_folder(folder)
    errors = folder / STDERR
    errors.unlink(missing_ok=True)  # it may be a link or a pipe
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
            # A new session: Ctrl-C in the terminal reaches the child only through its worker. The child inherits the
            # lock of the output folder, so the lock outlives a killed command.
            start_new_session=True,
            close_fds=False,
        )
    assert process.stdin is not None
    _children[key] = process
    try:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(message.to_line())
            process.stdin.flush()
        while process.poll() is None:
            if not requested():
                with contextlib.suppress(OSError):
                    process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(POLL_SECONDS)
    finally:
        del _children[key]
        with contextlib.suppress(OSError):
            process.stdin.close()  # the end of its input stops the child
    status = process.returncode
    if status == 0:
        return Outcome("done")
    lines = [line for line in errors.read_text(errors="replace").splitlines() if line.strip()]
    text = lines[-1].strip() if lines else f"the process ended with status {status}"
    return Outcome("lost" if status == STOPPED or status in KILLED else "failed", text)


def count_running(keys: Sequence[str]) -> int:
    """Return the number of jobs that have a process on this worker."""
    return len(_children.keys() & set(keys))


def kill(keys: Sequence[str]) -> None:
    """Kill the processes of jobs on this worker. Their last checkpoints remain."""
    for key, process in list(_children.items()):
        if key in keys:
            process.kill()
