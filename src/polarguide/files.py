"""Writing files: what is read is either the old file or the whole new one, and a failure says how to go on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from polarguide.errors import PolarguideError


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write to a temporary file that takes the place of ``path`` only when it is complete and on disk."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, completely or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_whole(path: Path, data: bytes) -> int:
    """Write a file that is there completely or not at all; returns its size.

    Raises:
        PolarguideError: it cannot be written, for example because the disk is full.
    """

    def write() -> None:
        with atomic(path) as temporary:
            temporary.write_bytes(data)

    guarded(write, path)
    return len(data)


def guarded(action: Callable[[], Any], path: Path) -> None:
    """Run what writes; an OSError becomes a message that says how to go on.

    Raises:
        PolarguideError: it failed.
    """
    try:
        action()
    except OSError as error:
        raise PolarguideError(
            path,
            expected="to write this file",
            found=error.strerror or str(error),
            remedy="Make room or give rights, and repeat the command: it goes on where it stopped.",
        ) from error
