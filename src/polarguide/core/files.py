"""Reading and atomic writing of files, with errors that explain failures."""

from __future__ import annotations

import contextlib
import csv
import glob
import io
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from polarguide.core.errors import PolarguideError
from polarguide.core.system import process_is_alive
from polarguide.core.text import canonical

LARGEST_FILE = 1 << 31


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write to a temporary file that replaces ``path`` when it is complete and on disk.

    Leftover temporary files of killed processes are removed.

    Yields:
        The path of the temporary file, in the same folder.

    Raises:
        PolarguideError: the file or folder cannot be written, for example because the disk is full.
    """
    temporary = _temporary(path)
    with writing(path):
        try:
            temporary.touch(exist_ok=False)
            rights = temporary.stat().st_mode
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            temporary.chmod(rights)  # some libraries replace the file by a file that only its owner may read
            os.replace(temporary, path)
            _sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Create a temporary folder next to ``path``, and remove it at the end.

    If the process is killed, the next call removes the leftover folder.

    Raises:
        PolarguideError: the file or folder cannot be written, for example because the disk is full.
    """
    temporary = _temporary(path)
    with writing(path):
        try:
            temporary.mkdir(parents=True)
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Write into a temporary folder, whose files are moved to ``path`` when all of them are complete.

    Yields:
        The temporary folder, next to ``path``, which is created.

    Raises:
        PolarguideError: the file or folder cannot be written, for example because the disk is full.
    """
    make_folder(path)
    with temporary_folder(path) as temporary:
        yield temporary
        for entry in sorted(temporary.iterdir()):
            with open(entry, "rb") as file:
                os.fsync(file.fileno())
        for entry in sorted(temporary.iterdir()):
            os.replace(entry, path / entry.name)
        _sync_folder(path)


def _temporary(path: Path) -> Path:
    """Return a temporary path for a file or folder, and remove leftover temporary files of ended processes.

    The name contains the number of this process. An existing file of this name is removed as well, because it belongs
    to an earlier process or is a malicious link.
    """
    with contextlib.suppress(OSError):
        for old in path.parent.glob(f".{glob.escape(path.name)}.*.tmp*"):
            process = old.name.removeprefix(f".{path.name}.").partition(".")[0]
            ours = process.isascii() and process.isdigit()
            if ours and (int(process) == os.getpid() or not process_is_alive(int(process))):
                with contextlib.suppress(OSError):
                    shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


@contextlib.contextmanager
def in_utf8(path: Path) -> Iterator[Path]:
    """Yield a path in UTF-8 to a file whose name may contain other bytes, which some libraries do not accept."""
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / "file"
            link.symlink_to(path.absolute())
            yield link
    else:
        yield path


def holds_files(folder: Path) -> bool:
    """Return True if a folder contains files, apart from leftover temporary files of killed processes."""
    return any(re.fullmatch(r"\..+\.\d+\.tmp", path.name) is None for path in folder.iterdir())


def write_whole(path: Path, data: bytes) -> int:
    """Write a file atomically and return its size.

    Raises:
        PolarguideError: the file cannot be written.
    """
    with atomic(path) as temporary:
        temporary.write_bytes(data)
    return len(data)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 atomically. Surrogates, which UTF-8 cannot encode, are escaped.

    Raises:
        PolarguideError: the file cannot be written.
    """
    write_whole(path, text.encode("utf-8", "backslashreplace"))


def make_folder(path: Path) -> None:
    """Create a folder and its parents unless it exists.

    Raises:
        PolarguideError: the folder cannot be created.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an OSError in this context to an error that explains why ``path`` could not be written.

    Raises:
        PolarguideError: the file cannot be written.
    """
    try:
        yield
    except OSError as error:
        # ``shutil.copytree`` raises one error with a list of all errors.
        several = isinstance(error, shutil.Error) and isinstance(error.args[0], list)
        raise PolarguideError(
            path,
            expected="to write this file",
            found=str(error.args[0][0][-1]) if several else error.strerror or str(error),
            remedy="Make room or give rights, and repeat the command: it goes on where it stopped.",
        ) from error


def stored(path: Path) -> Path:
    """Return the path under which the file system stores a file.

    If the path does not exist, but a file exists whose name differs only in the normal form of Unicode, the path of
    that file is returned.
    """
    if os.path.lexists(path) or path == path.parent:
        return path
    folder = stored(path.parent)
    same: list[Path] = []
    with contextlib.suppress(OSError):
        same = [entry for entry in folder.iterdir() if canonical(entry.name) == canonical(path.name)]
    return same[0] if len(same) == 1 else folder / path.name


def require_folder(path: Path, *, expected: str, remedy: str) -> None:
    """Check that a folder exists.

    Raises:
        PolarguideError: the path is a file, or does not exist.
    """
    if not path.is_dir():
        raise PolarguideError(
            path, expected=expected, found="a file" if path.exists() else "nothing", remedy=remedy
        )


def require_file(path: Path, *, expected: str, remedy: str) -> None:
    """Check that a path is a regular file, because reading a pipe or a device may block forever.

    Raises:
        PolarguideError: ``path`` is not a regular file, or does not exist.
    """
    if path.is_file():
        return
    found = "a folder" if path.is_dir() else "a pipe or device" if path.exists() else "nothing"
    raise PolarguideError(path, expected=expected, found=found, remedy=remedy)


def check_out(path: Path) -> None:
    """Check that an output folder exists or can be created.

    Raises:
        PolarguideError: the path is a file or a broken link, or contains a null byte.
    """
    if "\0" in os.fspath(path):
        raise PolarguideError(
            repr(os.fspath(path)),
            expected="a folder to write",
            found="a null byte",
            remedy="Give another --out.",
        )
    if os.path.lexists(path):
        require_folder(path, expected="a folder to write", remedy="Give another --out.")


def require_inside(folder: Path, *paths: Path) -> None:
    """Raise an error if a path in a folder leads out of it through a link.

    The content of the folder may come from another person, so its links are not trusted.

    Args:
        folder: the output folder, which may be a link itself.
        paths: paths in it, which need not exist.

    Raises:
        PolarguideError: a path lies outside the folder.
    """
    whole = Path(os.path.realpath(folder))
    for path in paths:
        real = Path(os.path.realpath(path))
        if not real.is_relative_to(whole):
            raise PolarguideError(
                path,
                expected=f"a place in {folder}",
                found=f"a link to {real}",
                remedy="Remove the link, or specify the linked folder with --out. No file was written there.",
            )


def read_file(
    path: Path, *, largest: int = LARGEST_FILE, remedy: str = "Check that the file exists and may be read."
) -> bytes:
    """Read a file.

    Args:
        path: the file.
        largest: largest accepted size of the file in bytes.
        remedy: advice for the error message.

    Raises:
        PolarguideError: the file cannot be read, or is too large.
    """
    try:
        about = path.stat()
        if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):  # reading it may block forever
            raise OSError("a pipe or device")
        if about.st_size > largest:
            raise OSError(f"one of {about.st_size} bytes, more than {largest >> 20} MiB")
        return path.read_bytes()
    except OSError as error:
        raise PolarguideError(
            path,
            expected="a readable file",
            found=error.strerror or str(error),
            remedy=remedy,
        ) from error


_LARGEST_TABLE = 1 << 26


def read_rows(path: Path, remedy: str) -> list[tuple[int, list[str]]]:
    """Return the line number (1-based) and the stripped cells of each row of a CSV file that is not empty.

    The delimiter is a comma or a semicolon, which spreadsheets use in some countries.

    Args:
        path: the file.
        remedy: advice for the message.

    Raises:
        PolarguideError: the file cannot be read, or is not CSV.
    """
    data = read_file(path, largest=_LARGEST_TABLE, remedy=remedy)
    rows: list[tuple[int, list[str]]] = []
    line = 0  # last line of the previous row
    try:
        text = data.decode("utf-8-sig")
        head = text.partition("\n")[0]
        reader = csv.reader(
            io.StringIO(text, newline=""),
            strict=True,
            skipinitialspace=True,
            delimiter=";" if head.count(";") > head.count(",") else ",",
        )
        for row in reader:
            if any("\0" in cell for cell in row):
                raise csv.Error("a null character")
            line = reader.line_num
            rows.append((line, [cell.strip() for cell in row]))
    except (UnicodeDecodeError, csv.Error) as error:
        where = path if isinstance(error, UnicodeDecodeError) else f"{path} (line {line + 1})"
        raise PolarguideError(
            where, expected="CSV text in UTF-8", found=f"something else ({error})", remedy=remedy
        ) from None
    return [(number, row) for number, row in rows if any(row)]


def _sync_folder(folder: Path) -> None:
    """Flush a folder to disk, so that a renamed file survives a power failure, on systems that support this."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
