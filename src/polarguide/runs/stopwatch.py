"""Time that a piece of work takes, and whether other work ran beside it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from polarguide.core.system import machine_busy_seconds

# Share of one core that others may use before a time is no longer worth quoting.
FOREIGN_SHARE = 0.10


class Stopwatch:
    """Adds up wall time, and compares the machine's busy time with this process's own.

    Args:
        seconds: time already spent (before a resume). alone: whether that was spent alone.
    """

    def __init__(self, seconds: float = 0.0, alone: bool = True) -> None:
        self._before = seconds
        self._alone = alone
        self._pause = 0.0
        self._start = time.perf_counter()
        self._own = time.process_time()
        self._machine = machine_busy_seconds()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Time inside does not count."""
        begin = time.perf_counter()
        yield
        self._pause += time.perf_counter() - begin

    def read(self) -> tuple[float, bool]:
        """Seconds so far, and whether nothing else of weight ran beside."""
        wall = time.perf_counter() - self._start
        foreign = (machine_busy_seconds() - self._machine) - (time.process_time() - self._own)
        alone = self._alone and foreign <= FOREIGN_SHARE * wall + 0.5
        return self._before + wall - self._pause, alone


def in_words(seconds: float) -> str:
    """A time as 40 s, 12 min or 1 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
