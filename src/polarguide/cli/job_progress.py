"""Progress of many pieces of work at a time: a line for each that is under way."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from polarguide.cli.console import console
from polarguide.cli.progress import ConsoleReporter, bars, lines
from polarguide.progress import Advance

# Trainings log every tenth step and recipes differ in speed: a long memory keeps the time left from jumping.
MEMORY_SECONDS = 300.0


class JobReporter(ConsoleReporter):
    """Prints as ``ConsoleReporter``, with one display for all bars that are open together."""

    def __init__(self) -> None:
        self._open = 0
        self._progress = bars(MEMORY_SECONDS)

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
        task = self._progress.add_task(label, total=total, note="")

        def advance(done: int, *, total: int | None = None, note: str = "") -> None:
            self._progress.update(task, completed=done, total=total, note=note)

        try:
            yield advance
        finally:
            self._progress.remove_task(task)
            self._open -= 1
            if not self._open:
                self._progress.stop()
