"""Console output: messages, warnings, and progress as bars on a terminal or as lines elsewhere."""

from __future__ import annotations

import contextlib
import importlib
import re
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column

import polarguide
from polarguide.core.errors import PolarguideWarning
from polarguide.core.options import ComputeOptions, ThreadOptions
from polarguide.core.progress import Advance, Reporter
from polarguide.core.text import printable

console = Console(highlight=False, soft_wrap=True)


# Texts from files and the command line may have megabytes, which would hide the error.
_LONG_WORD = re.compile(r"\S{1000,}?(?=:?(?:\s|$))")


def say(text: object, *, lines: bool = False, to: Console = console) -> None:
    """Print a text without markup and control characters. With ``lines`` its line breaks are kept."""
    to.print(printable(str(text), lines=lines), markup=False)


def warn(text: object) -> None:
    """Print a warning without markup and control characters."""
    console.print("[yellow]warning:[/] ", end="")
    say(text)


def print_error(text: str) -> None:
    """Print an error on the standard error stream. Words of a thousand characters and more are truncated."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
    errors.print("[bold red]error:[/] ", end="")
    say(_LONG_WORD.sub(lambda word: word[0][:200] + "...", text), to=errors)


def size_text(size: int) -> str:
    """Return the size of a file as text, in MB or kB."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(1, round(size / 1e3))} kB"


@contextlib.contextmanager
def warnings_printed() -> Iterator[None]:
    """Print the library's warnings on the console inside this context."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PolarguideWarning)
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, PolarguideWarning):
                warn(message)
            else:
                others(message, category, *where, **more)

        warnings.showwarning = show
        yield


def set_threads(threads: int) -> None:
    """Set the number of threads of our kernels, torch and OpenCV; 0 keeps their defaults."""
    if threads:
        importlib.import_module("polarguide.raster").use_threads(threads)
        importlib.import_module("cv2").setNumThreads(threads)


LINE_SECONDS = 15.0
"""Least time in seconds between two lines of progress without a terminal."""
MEASURED = 0.05
"""Share of the steps before the remaining time is estimated."""
UNKNOWN_TIME = "-:--:--"


class Rate:
    """Rate of a piece of work since its first report.

    Args:
        total: amount of work; None: not known yet.
        clock: time of reports that do not state their own.

    Attributes:
        total: amount of work, possibly updated by a report.
    """

    def __init__(self, total: int | None, clock: Callable[[], float] = time.monotonic) -> None:
        self.total = total
        self.clock = clock
        self._first: tuple[float, int] | None = None

    def left(self, done: int, total: int | None = None, seconds: float | None = None) -> float | None:
        """Return the estimated remaining time in seconds, or None before enough work is done.

        Args:
            done, total, seconds: see ``core.progress.Advance``.
        """
        self.total = total or self.total
        now = self.clock() if seconds is None else seconds
        if self._first is None:  # a resumed training does not begin at step 0
            self._first = (now, done)
        begin, first = self._first
        steps = done - first
        if self.total is None or steps < max(1, MEASURED * (self.total - first)):
            return None
        return (now - begin) / steps * max(0, self.total - done)


def duration_text(seconds: float | None) -> str:
    """Return a duration as hours, minutes and seconds."""
    if seconds is None:
        return UNKNOWN_TIME
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def bars() -> Progress:
    """Return a display of progress bars with the fields ``note`` and ``left``.

    Step, total and remaining time are always visible; label and note share the remaining width.
    """
    cut: dict[str, Any] = {"no_wrap": True, "overflow": "ellipsis"}
    return Progress(
        TextColumn("{task.description}", markup=False, table_column=Column(max_width=26, **cut)),
        BarColumn(bar_width=10),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[left]}", style="progress.remaining", table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[note]}", markup=False, table_column=Column(ratio=1, **cut)),
        console=console,
        transient=True,
        expand=True,
    )  # fmt: skip


class Lines:
    """Progress of one piece of work as lines of a log, at most one every ``LINE_SECONDS``."""

    def __init__(self, label: str, total: int | None, clock: Callable[[], float] = time.monotonic) -> None:
        self._label = label
        self._rate = Rate(total, clock)
        self._last = clock()
        self._line = ""
        self._noted = False

    def __call__(
        self, done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
    ) -> None:
        """See ``core.progress.Advance``."""
        now = self._rate.clock()
        left = self._rate.left(done, total, seconds)
        time_left = f", {duration_text(left)} left" if left else ""
        of = "" if self._rate.total is None else f"/{self._rate.total}"
        self._line = f"{self._label} {done}{of}{time_left}" + (f"  {note}" if note else "")
        self._noted = bool(note)
        if now - self._last >= LINE_SECONDS:
            self._last = now
            say(self._line)
            self._line = ""

    def close(self) -> None:
        """Print the last state if it has a note, like the bar that stays on a terminal."""
        if self._noted and self._line:
            say(self._line)


class ConsoleReporter(Reporter):
    """Reporter that prints messages, and one display with a bar for each piece of work in progress.

    The last bar stays on the terminal if it has a note.
    """

    def __init__(self) -> None:
        self._display = bars()

    def say(self, text: str) -> None:
        """Print a result without markup."""
        say(text, lines=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        warn(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Show a progress bar below the open ones, or print lines without a terminal."""
        label = printable(label)
        if not console.is_terminal:
            lines = Lines(label, total)
            try:
                yield lines
            finally:
                lines.close()
            return
        display = self._display
        display.start()
        task = display.add_task(label, total=total, note="", left=UNKNOWN_TIME)
        rate = Rate(total)

        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            left = duration_text(rate.left(done, total, seconds))
            display.live.transient = not note
            display.update(task, completed=done, total=total, note=note, left=left)

        try:
            yield advance
        finally:
            if len(display.tasks) == 1:
                display.stop()
            display.remove_task(task)


if TYPE_CHECKING:
    from polarguide import Run

RunFolder = Annotated[Path, tyro.conf.Positional]


def open_run_folder(run: Path, compute: ThreadOptions) -> tuple[Run, ConsoleReporter]:
    """Open a run on the device of the options (default: the CPU); returns the run and the console's reporter."""
    set_threads(compute.threads)
    reporter = ConsoleReporter()
    return polarguide.open_run(
        run, device=compute.device if isinstance(compute, ComputeOptions) else "cpu", reporter=reporter
    ), reporter
