"""A child process of a comparison: trains or scores one run, as a task on standard input says."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.options import ComputeOptions, SceneOptions, SessionOptions
from polarguide.core.records import decode, to_json
from polarguide.core.system import StopSignals, keep_freed_memory
from polarguide.raster import use_threads
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import train
from polarguide.training.settings import TrainSettings

PACKAGE = Path(__file__).parents[1]
PROLOGUE = (
    "import sys; sys.path[:] = [path for path in sys.path if path]; "  # what is empty is the current folder
    "sys.path[:0] = [path for path in sys.argv[1:] if path not in sys.path]; "
    "from polarguide.experiments.worker import main; sys.exit(main())"
)
"""What a child runs: it imports this package from where it is here, and nothing from the current folder."""
COMMAND = (sys.executable, "-c", PROLOGUE, str(PACKAGE.parent))


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="train"):
    """Train a run, or go on with it."""

    scene: str
    folder: str
    recipe: str
    settings: TrainSettings
    reading: SceneOptions
    compute: ComputeOptions
    resume: bool


class Scoring(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="score"):
    """Score a finished run; with ``speed`` also time its pictures."""

    folder: str
    speed: bool
    compute: ComputeOptions


Task = Training | Scoring


def main() -> int:
    """Do the task on standard input; returns the exit status (0 done, 130 stopped, 2 wrong input, with one line)."""
    # As Ctrl-C does, so that whatever is open is closed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    keep_freed_memory()
    try:
        kind: Any = Task
        do(decode(sys.stdin.buffer.read(), kind, "task"))
    except PolarguideError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        print(f"{error.filename or 'files'}: {error.strerror or error}.", file=sys.stderr)
        return 2
    return 0


def encoded(task: Task) -> bytes:
    """A task as ``main`` reads it."""
    return to_json(msgspec.to_builtins(task))


def do(task: Task) -> None:
    """Train or score.

    Raises:
        PolarguideError: the input is wrong, or the training has diverged.
        KeyboardInterrupt: stopped by SIGINT; a training has saved its state.
    """
    use_threads(task.compute.threads)
    if isinstance(task, Scoring):
        evaluate(OpenedRun.open(task.folder, device=task.compute.device), speed=task.speed)
        return
    with StopSignals() as should_stop:
        train(
            task.scene,
            task.folder,
            recipe=task.recipe,
            settings=task.settings,
            session=SessionOptions(task.compute.threads, task.compute.device),
            reading=task.reading,
            resume=task.resume,
            should_stop=should_stop,
        )
