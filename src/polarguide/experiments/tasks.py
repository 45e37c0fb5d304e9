"""Tasks of the processes of a comparison or a batch, and what becomes of them. Does not import torch."""

from __future__ import annotations

import hashlib
import json
import sys
from functools import cache
from pathlib import Path
from typing import Literal

import msgspec

from polarguide.core.options import ComputeOptions, SceneOptions
from polarguide.experiments.collection import Processing
from polarguide.training.settings import TrainSettings

PACKAGE = Path(__file__).parents[1]
PROLOGUE = (
    "import gc, sys; gc.disable(); "  # while names are imported, which stay: a fifth of the seconds
    "sys.path[:] = [path for path in sys.path if path]; "  # what is empty is the current folder
    "sys.path[:0] = [path for path in sys.argv[1:] if path not in sys.path]; "
    "from polarguide.experiments.worker import main; gc.enable(); sys.exit(main())"
)
"""What a child runs: it imports this package from where it is here, and nothing from the current folder."""
COMMAND = (sys.executable, "-c", PROLOGUE, str(PACKAGE.parent))


@cache
def files_digest() -> str:
    """Sixteen hexadecimal digits that change with any byte of this package's code."""
    digest = hashlib.sha256()
    for path in sorted(
        (*PACKAGE.rglob("*.py"), *PACKAGE.glob("_native.*.so"), *PACKAGE.glob("_native.*.pyd"))
    ):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {path.stat().st_size}\n".encode())
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
    """What a child reads, on one line: its task, and the code of who gives it.

    Attributes:
        files: its ``files_digest``. code: its ``code_digest``, which takes seconds, and counts where ``files`` differs.
    """

    task: Task
    files: str
    code: str


class Outcome(msgspec.Struct, frozen=True):
    """What became of a job on a worker.

    Attributes:
        state: "done"; "failed", with the last line of its ``stderr.txt``; "lost", when it was ended from outside, so
            that it can go on elsewhere.
        error: that line, or how it ended.
    """

    state: Literal["done", "failed", "lost"]
    error: str = ""


def encoded(message: Message) -> bytes:
    """A line that a child reads; names of files that are no Unicode are escapes in it."""
    return json.dumps(msgspec.to_builtins(message)).encode() + b"\n"
