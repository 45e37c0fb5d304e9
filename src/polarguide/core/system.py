"""Signals, locks, memory, processes, and validation of environment variables."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import math
import os
import re
import signal
import socket
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import psutil

from polarguide.core.errors import PolarguideError
from polarguide.core.options import MOST_THREADS

MEBIBYTE = 1 << 20
# Options of ``mallopt`` in glibc's malloc.h
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
NEARLY = 0.9
"""Share of a memory limit above which freed memory is returned to the system."""
GROWTH = 1.05
"""Memory relative to the largest step above which freed memory is returned again."""
SETTLED = 3
"""Number of steps after which the memory of the largest step is known."""
PARTLY = 0.5
"""Share of a memory limit above which ``MemoryBound.clear`` returns freed memory."""
_NOT_BUSY = {"idle", "iowait", "guest", "guest_nice"}
"""Processor times that do not count as busy: idle times, and times that user time already includes."""

Item = TypeVar("Item")


def _posix(module: str) -> Any | None:
    """Import a module of the standard library that only POSIX systems have; return None on other systems."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


def stop_signals() -> list[int]:
    """Return the signals that stop a process: SIGTERM, and SIGHUP unless it is ignored (nohup) or does not exist."""
    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [
        number for number in signals if signal.getsignal(number) != signal.SIG_IGN or number == signal.SIGTERM
    ]


_interrupts: list[int] = []


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handle a signal: record it and raise KeyboardInterrupt, as Python's own signal handler does.

    The record is needed, because packages may catch the exception during an import and raise another error.
    """
    _interrupts.append(number)
    signal.default_int_handler(number, frame)


def interrupts() -> int:
    """Return the number of signals that ``interrupt`` has handled in this process."""
    return len(_interrupts)


class StopSignals:
    """Context in which Ctrl-C, SIGTERM and SIGHUP stop a training after its current step.

    The object is the argument ``should_stop`` of a training. Before its first call, a signal interrupts at once. A
    second Ctrl-C also interrupts at once.
    """

    def __init__(self) -> None:
        self._stopping = self._works = False

    def __enter__(self) -> StopSignals:
        self._old = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, *stop_signals())}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        self._works = True
        return self._stopping

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._works:
            if self._stopping and number == signal.SIGINT:
                interrupt(number, frame)
            self._stopping = True
        else:
            interrupt(number, frame)


@contextlib.contextmanager
def sigterm_kept() -> Iterator[None]:
    """Restore the handler of SIGTERM at the end, because some libraries replace it when they are loaded."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def only_writer(lock: Path, *, expected: str, found: str) -> Iterator[None]:
    """Lock a folder against other processes that write to it.

    The lock is on a file in the folder, or on the folder itself if the system supports this. Child processes inherit
    the lock of a file. If this process is killed, they still hold the lock.

    Args:
        lock: file or folder to lock.
        expected, found: fields of the error message.

    Raises:
        PolarguideError: another process holds the lock.
        OSError: the file cannot be opened, or it is a link, which may lead to a file of another user.
    """
    fcntl = _posix("fcntl")
    is_folder = lock.is_dir()
    if fcntl is None and is_folder:
        yield
        return
    created = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    handle = os.open(lock, os.O_RDONLY if is_folder else created, 0o666)
    try:
        try:
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PolarguideError(
                lock if is_folder else lock.parent,
                expected=expected,
                found=found,
                remedy="Wait until the other command has ended, or choose another folder with --out.",
            ) from None
        except OSError:
            if not is_folder:  # some network file systems cannot lock folders
                raise
        os.set_inheritable(handle, not is_folder)
        yield
    finally:
        os.close(handle)


def peak_memory_mib() -> float | None:
    """Return the peak memory of this process in MiB, or None if the system does not report it."""
    resource = _posix("resource")
    if resource is None:
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak / MEBIBYTE if os.uname().sysname == "Darwin" else peak / 1024


def resident_memory() -> int:
    """Return the resident memory of this process in bytes."""
    return int(psutil.Process().memory_info().rss)


def return_freed_memory() -> None:
    """Return freed memory to the system if glibc's allocator is in use."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


class MemoryBound:
    """Memory limit of a process, near which freed memory is returned to the system.

    The allocator keeps freed memory for later use (``keep_freed_memory``). When sizes change, for example with the
    number of Gaussians, free blocks of old sizes remain between used blocks and waste memory.

    Args:
        limit: memory limit of the process in bytes. With infinity, memory is never returned.
    """

    def __init__(self, limit: float = math.inf) -> None:
        self._limit = limit
        self._least = NEARLY * limit
        self._bound = self._least
        self._most = 0.0
        self._waits = 0

    def keep(self) -> None:
        """Return freed memory to the system near the limit. Call it once per step if steps allocate similar sizes."""
        resident = resident_memory()
        if self._waits:  # memory below the largest step would be allocated again at once
            self._most = max(self._most, resident)
            self._waits -= 1
            self._bound = min(max(self._least, GROWTH * self._most), self._limit)
        elif resident > self._bound:
            return_freed_memory()
            self._most = 0.0
            self._waits = SETTLED

    def clear(self) -> None:
        """Return freed memory to the system above half of the limit. Call it between operations of different sizes."""
        if resident_memory() > PARTLY * self._limit:
            return_freed_memory()

    def between(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items; call ``clear`` before each item and after the last one.

        This avoids fragmentation: memory that an item keeps does not lie between blocks that earlier items have freed.
        """
        iterator = iter(items)
        while True:
            self.clear()
            try:
                item = next(iterator)
            except StopIteration:
                return
            yield item


UNBOUNDED = MemoryBound()


def keep_freed_memory() -> None:
    """Configure glibc's allocator to keep freed memory for the rest of this process.

    Each training step frees and allocates the same hundred megabytes. By default glibc returns them to the system,
    which clears the pages again. Only the entry points of programs call this, not modules during import.
    """
    try:
        libc = ctypes.CDLL(None)
        libc.gnu_get_libc_version  # noqa: B018, elsewhere the numbers below may mean something else
    except (AttributeError, OSError, TypeError):
        return
    libc.mallopt(M_TRIM_THRESHOLD, -1)  # never
    if not libc.mallopt(M_MMAP_THRESHOLD, 1 << 30):
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 25)  # the largest value of older versions


def network_address() -> str | None:
    """Return the address of this machine in its network, or None without a network. No data is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address for documentation
        except OSError:
            return None
        return str(probe.getsockname()[0])


def free_memory(group: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the number of bytes that this process may still allocate.

    It is the free memory of the system or of the process's control group, whichever is smaller. Cached files of a
    control group count as free, because the system drops them on demand.
    """
    available = int(psutil.virtual_memory().available)
    with contextlib.suppress(OSError, ValueError):
        free = int((group / "memory.max").read_text()) - int((group / "memory.current").read_text())
        statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        files = int(statistics.get("inactive_file", 0)) + int(statistics.get("active_file", 0))
        available = min(available, free + files)
    return max(0, available)


def machine_busy_seconds() -> float:
    """Return the busy processor time of the whole machine in seconds."""
    times = psutil.cpu_times()._asdict()
    return float(sum(seconds for name, seconds in times.items() if name not in _NOT_BUSY))


def process_is_alive(pid: int) -> bool:
    """Return True if a process runs. A zombie does not run."""
    try:
        return psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return True


_SIZE = re.compile(r"[0-9]{1,18}(KB|Kb|kb|MB|Mb|mb)?")
_SIZES = re.compile(r"OPENCV_(IO_MAX_IMAGE_[A-Z]+|IMGCODECS_[A-Z]+_MAX_FILE_SIZE)")
"""Environment variables with sizes that OpenCV reads when it is loaded. An invalid size would end the process."""


def check_variables() -> None:
    """Validate the environment variables of OpenCV and of the kernels, because invalid values would end the process.

    Raises:
        PolarguideError: a variable is invalid, or the number of threads is too large.
    """
    threads = os.environ.get("POLARGUIDE_THREADS", "").strip()
    wrong = {}
    if threads.isdecimal() and len(threads) < 1000 and int(threads) > MOST_THREADS:
        wrong["POLARGUIDE_THREADS"] = f"a number up to {MOST_THREADS}"
    for name, text in os.environ.items():
        if _SIZES.fullmatch(name) and not _SIZE.fullmatch(text):
            wrong[name] = "a whole number"
    for name, expected in wrong.items():
        raise PolarguideError(
            f"the variable {name}",
            expected=expected,
            found=repr(os.environ[name][:100]),
            remedy=f"Correct the value, or unset {name}.",
        )
