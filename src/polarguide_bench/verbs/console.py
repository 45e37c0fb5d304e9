"""Progress of many jobs on one console."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from polarguide.cli.console import UNKNOWN_TIME, ConsoleReporter, Rate, bars, clock, console, lines
from polarguide.core.progress import Advance


class JobReporter(ConsoleReporter):
    """Prints as ``ConsoleReporter``, with one display for all bars that are open together."""

    def __init__(self) -> None:
        self._open = 0
        self._progress = bars()

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """A progress bar below those that are open already."""
        if not console.is_terminal:
            with lines(label, total) as tell:
                yield tell
            return
        if not self._open:
            self._progress.start()
        self._open += 1
        task = self._progress.add_task(label, total=total, note="", left=UNKNOWN_TIME)
        rate = Rate(total)

        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            left = clock(rate.left(done, total, seconds))
            self._progress.update(task, completed=done, total=total, note=note, left=left)

        try:
            yield advance
        finally:
            self._progress.remove_task(task)
            self._open -= 1
            if not self._open:
                self._progress.stop()
