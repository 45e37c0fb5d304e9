"""Messages and progress on the console: bars on a terminal, a line every so often anywhere else."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

from polarguide.cli.console import console, say, warn
from polarguide.printable import printable
from polarguide.progress import Advance, Reporter

LINE_SECONDS = 15.0
"""Between two lines of progress where there is no terminal."""
SPEED_SECONDS = 180.0
"""The speed of so long tells the time left: of a training whose pictures grow, the steps of the beginning are cheap."""


def bars(memory_seconds: float = 30.0) -> Progress:
    """A display of progress bars; the time left follows from the speed of the last seconds.

    Step, total and time left are always shown; label and note share what room is left, and are cut.
    """
    label = Column(no_wrap=True, overflow="ellipsis", max_width=26)
    note = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    return Progress(
        TextColumn("{task.description}", markup=False, table_column=label),
        BarColumn(bar_width=10),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[note]}", markup=False, table_column=note),
        console=console,
        transient=True,
        expand=True,
        speed_estimate_period=memory_seconds,
    )  # fmt: skip


class Lines:
    """Progress of one piece of work as lines, for logs: not more often than every ``LINE_SECONDS``."""

    def __init__(self, label: str, total: int | None, clock: Callable[[], float] = time.monotonic) -> None:
        self._label, self._total, self._clock = label, total, clock
        self._last = clock()
        self._seen: deque[tuple[float, int]] = deque()  # when how much was done, about once a second
        self._line = ""

    def __call__(self, done: int, *, total: int | None = None, note: str = "") -> None:
        """See ``progress.Advance``."""
        now = self._clock()
        self._total = total or self._total
        if not self._seen or now - self._seen[-1][0] >= 1:
            self._seen.append((now, done))
        while len(self._seen) > 2 and now - self._seen[1][0] >= SPEED_SECONDS:
            self._seen.popleft()
        begin, first = self._seen[0]  # a training that goes on does not begin at 0
        finished = self._total is not None and done >= self._total
        left = ""
        if self._total is not None and done > first and not finished:
            seconds = round((now - begin) * (self._total - done) / (done - first))
            left = f", {seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"
        of = "" if self._total is None else f"/{self._total}"
        self._line = f"{self._label} {done}{of}{left}" + (f"  {note}" if note else "")
        if now - self._last >= LINE_SECONDS:
            self._last = now
            self._print()

    def close(self, *, last: bool) -> None:
        """Print the last state if it stays on a terminal, too."""
        if last:
            self._print()

    def _print(self) -> None:
        if self._line:
            say(self._line)
            self._line = ""


class ConsoleReporter(Reporter):
    """What work reports, printed. Bars disappear at the end, but for those with a note."""

    def say(self, text: str) -> None:
        """Print a finding; brackets in it are shown as they are."""
        say(text, lines=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        warn(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """A progress bar, or lines where there is no terminal."""
        label = printable(label)
        if not console.is_terminal:
            with lines(label, total) as tell:
                yield tell
            return
        with bars() as progress:
            task = progress.add_task(label, total=total, note="")

            def advance(done: int, *, total: int | None = None, note: str = "") -> None:
                progress.live.transient = not note
                progress.update(task, completed=done, total=total, note=note)

            yield advance


@contextlib.contextmanager
def lines(label: str, total: int | None) -> Iterator[Advance]:
    """Progress as lines; the last one is printed where the work had a note."""
    told = Lines(label, total)
    noted = False

    def advance(done: int, *, total: int | None = None, note: str = "") -> None:
        nonlocal noted
        noted = bool(note)
        told(done, total=total, note=note)

    try:
        yield advance
    finally:
        told.close(last=noted)
