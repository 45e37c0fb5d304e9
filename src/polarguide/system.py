"""What only some operating systems offer; elsewhere each function says that it does not know, or does nothing."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MEBIBYTE = 1 << 20


def _posix(module: str) -> Any | None:
    """A module of the standard library that POSIX systems alone have."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


def termination_signals() -> tuple[signal.Signals, ...]:
    """Signals beside Ctrl-C by which a process is asked to end: SIGTERM, and SIGHUP where there is one."""
    names = ("SIGTERM", "SIGHUP")
    return tuple(getattr(signal, name) for name in names if hasattr(signal, name))


@contextlib.contextmanager
def sigterm_kept() -> Iterator[None]:
    """Keep the handler of SIGTERM, which some libraries replace as they are loaded."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """Hold a lock on a file. Child processes inherit it, and keep it if this process is killed.

    Raises:
        BlockingIOError: another process holds it.
    """
    fcntl = _posix("fcntl")
    with open(path, "w") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.set_inheritable(file.fileno(), True)
        yield


def peak_memory_mib() -> float | None:
    """The most memory in MiB that this process has held at a time, or None where the system does not tell."""
    resource = _posix("resource")
    if resource is None:
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak / MEBIBYTE if os.uname().sysname == "Darwin" else peak / 1024


def machine_busy_seconds() -> float | None:
    """Processor seconds that the whole machine has been busy, or None where the system does not tell."""
    try:
        fields = [int(x) for x in Path("/proc/stat").read_text().partition("\n")[0].split()[1:]]
    except (OSError, ValueError):
        return None
    user, nice, system, _, _, irq, softirq, *rest = fields
    steal = rest[0] if rest else 0
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def process_is_alive(pid: int) -> bool:
    """Whether a process runs; a zombie, which has ended and waits to be asked about, does not."""
    if os.name != "posix":  # there, signal 0 would end it
        return True
    try:
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except ProcessLookupError:
        return False
    except (OSError, IndexError):  # not ours to signal, or a system without /proc
        return True
    return state not in "ZX"


def process_rank() -> int:
    """The number of this process among those that torchrun started; 0 without it."""
    return int(os.environ.get("RANK", "0"))


def process_count() -> int:
    """How many processes torchrun started for this training; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))
