"""What cases that nobody draws at random are made of: a change to a copy of the base, a command line, a reason."""

from __future__ import annotations

import importlib
import json
import os
import random
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forked import Case

Change = Callable[[Path], object]
PICTURE, TRUTH, MOSAIC = "scene/polar/v001_045.png", "scene/gt/v000.npz", "mosaics/v001.png"
SAME = "it is the same content in another form"
UNUSED = "what is wrong with it is not read"


@dataclass(frozen=True)
class MadeCase(Case):
    """A case of these; ``command`` is its verb."""

    command: str = ""


def made_case(
    name: str,
    change: Change,
    command: Sequence[str],
    accepted: str = "",
    check: Callable[[Path], None] | None = None,
    says: str = "",
) -> MadeCase:
    """A case that changes something by hand and runs a command; see ``Case``."""

    def make(folder: Path, rng: random.Random) -> list[str]:
        change(folder)
        return list(command)

    return MadeCase(name, 0, make, accepted, check, says, command[0] if command else "")


def more_case(name: str, *arguments: Any, **more: Any) -> MadeCase:
    """The same with "more" before its name."""
    return made_case(f"more {name}", *arguments, **more)


def nothing(folder: Path) -> None:
    """Leave the base as it is: the command line alone is wrong."""


def of_bytes(path: str, data: bytes) -> Change:
    """Write a file."""
    return lambda folder: (folder / path).write_bytes(data)


def of_json(path: str, content: Any) -> Change:
    """Write a JSON file."""
    return of_bytes(path, json.dumps(content).encode())


def small_machine(then: Change) -> Change:
    """As on a machine with 2 GiB of free memory."""

    def change(folder: Path) -> None:
        memory = importlib.import_module("polarguide.capture.memory")
        memory.free_memory = lambda: 2 << 30  # type: ignore[attr-defined]
        then(folder)

    return change


def instead(
    suffix: str, write: Callable[..., None], *arguments: Any, at: str = PICTURE, **more: Any
) -> Change:
    """A file of another suffix in the place of a picture."""

    def change(folder: Path) -> None:
        path = folder / at
        path.unlink()
        write(path.with_suffix(suffix), *arguments, **more)

    return change


def sparse(path: Path, size: int, begin: bytes) -> None:
    """A file of a size that takes no room."""
    with open(path, "wb") as file:
        file.write(begin)
        file.truncate(size)


def link(path: str, target: str = "../../outside") -> Change:
    """A link in a file's or folder's place."""

    def change(folder: Path) -> None:
        place = folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.symlink_to(target)

    return change


def put(path: str, how: str) -> Change:
    """Something else in a file's or folder's place, be there anything or not."""

    def change(folder: Path) -> None:
        target = folder / path
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        if how == "file":
            target.write_text("no folder")
        elif how == "folder":
            target.mkdir()
        elif how == "pipe":
            os.mkfifo(target)
        elif how == "device":
            target.symlink_to("/dev/zero")
        elif how == "loop":
            target.symlink_to(target.name)
        elif how == "root":
            target.symlink_to("/")
        elif how == "itself":
            target.symlink_to(".")
        elif how == "dangling":
            target.symlink_to("nowhere")
        elif how == "outside":
            target.symlink_to(folder.parent / "outside/victim.txt")
        elif how == "empty":
            target.write_bytes(b"")
        else:
            raise ValueError(how)

    return change
