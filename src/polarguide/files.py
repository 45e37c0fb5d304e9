"""Reading and writing files: what is read is either the old file or the whole new one; failures are explained."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from polarguide.errors import PolarguideError

_LARGEST_FILE = 1 << 31


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write to a temporary file that takes the place of ``path`` only when it is complete and on disk.

    Yields:
        The temporary file's path, in the same folder.

    Raises:
        PolarguideError: it cannot be written, for example because the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with writing(path):
        try:
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
            _sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> int:
    """Write a file completely or not at all; returns its size.

    Raises:
        PolarguideError: it cannot be written.
    """
    with atomic(path) as temporary:
        temporary.write_bytes(data)
    return len(data)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, completely or not at all.

    Raises:
        PolarguideError: it cannot be written.
    """
    write_whole(path, text.encode())


def make_folder(path: Path) -> None:
    """Create a folder and those above it, unless it exists.

    Raises:
        PolarguideError: it cannot be created.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError of what writes ``path`` into a message that says how to go on.

    Raises:
        PolarguideError: there was one.
    """
    try:
        yield
    except OSError as error:
        raise PolarguideError(
            path,
            expected="to write this file",
            found=error.strerror or str(error),
            remedy="Make room or give rights, and repeat the command: it goes on where it stopped.",
        ) from error


def require_folder(path: Path, *, expected: str, remedy: str) -> None:
    """Check that a folder exists.

    Raises:
        PolarguideError: there is a file of this name, or nothing.
    """
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise PolarguideError(path, expected=expected, found=found, remedy=remedy)


def check_out(path: Path) -> None:
    """Check that a folder can be written to where there may be none yet.

    Raises:
        PolarguideError: there is a file of this name.
    """
    if path.exists():
        require_folder(path, expected="a folder to write", remedy="Give another --out.")


def read_file(path: Path, *, remedy: str = "Check that the file exists and may be read.") -> bytes:
    """The bytes of a file of up to 2 GiB; ``remedy`` is for messages.

    Raises:
        PolarguideError: the file cannot be read.
    """
    try:
        about = path.stat()
        if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):  # reading may never end
            raise OSError("a pipe or device")
        if about.st_size > _LARGEST_FILE:
            raise OSError(f"one of {about.st_size} bytes, more than 2 GiB")
        return path.read_bytes()
    except OSError as error:
        raise PolarguideError(
            path,
            expected="a readable file",
            found=error.strerror or str(error),
            remedy=remedy,
        ) from error


def _sync_folder(folder: Path) -> None:
    """Make a rename in a folder durable, on systems that can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
