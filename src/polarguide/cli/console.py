"""The console: messages, warnings and progress, as bars on a terminal and as lines anywhere else."""

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
from polarguide.core.system import process_rank
from polarguide.core.text import printable

# Of several processes of one training, the first alone talks.
console = Console(highlight=False, soft_wrap=True, quiet=process_rank() > 0)


# Of a file or the command line: megabytes of it hide what is wrong.
_LONG_WORD = re.compile(r"\S{1000,}?(?=:?(?:\s|$))")


def say(text: object, *, lines: bool = False, to: Console = console) -> None:
    """Print a text, of several ``lines``: names in it are neither markup, nor anything that a terminal obeys."""
    to.print(printable(str(text), lines=lines), markup=False)


def warn(text: object) -> None:
    """Print a warning; names in it are shown as they are, but for control characters."""
    console.print("[yellow]warning:[/] ", end="")
    say(text)


def print_error(text: str) -> None:
    """Print an error on the standard error stream, with words of a thousand characters and more cut."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
    errors.print("[bold red]error:[/] ", end="")
    say(_LONG_WORD.sub(lambda word: word[0][:200] + "...", text), to=errors)


def size_text(size: int) -> str:
    """The size of a file in bytes, for people."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(1, round(size / 1e3))} kB"


@contextlib.contextmanager
def warnings_printed() -> Iterator[None]:
    """Inside, the library's warnings are lines on the console."""
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
    """Let our kernels, torch and OpenCV use this many threads; 0 leaves their defaults."""
    if threads:
        importlib.import_module("polarguide.raster").use_threads(threads)
        importlib.import_module("cv2").setNumThreads(threads)


LINE_SECONDS = 15.0
"""Between two lines of progress where there is no terminal."""
MEASURED = 0.05
"""Share of the steps that is measured before their rate tells the time left."""
UNKNOWN_TIME = "-:--:--"


class Rate:
    """Measures how fast a piece of work advances, from the first report on.

    Args:
        total: how much there is to do; None where that is not known yet.
        clock: gives the seconds of a report that does not state them.

    Attributes:
        total: as above, or as a report has stated since.
    """

    def __init__(self, total: int | None, clock: Callable[[], float] = time.monotonic) -> None:
        self.total = total
        self.clock = clock
        self._first: tuple[float, int] | None = None

    def left(self, done: int, total: int | None = None, seconds: float | None = None) -> float | None:
        """Seconds that the remaining steps take at the rate so far; None before it is measured.

        Args:
            done, total, seconds: see ``core.progress.Advance``.
        """
        self.total = total or self.total
        now = self.clock() if seconds is None else seconds
        if self._first is None:  # a training that is resumed does not begin at step 0
            self._first = (now, done)
        begin, first = self._first
        steps = done - first
        if self.total is None or steps < max(1, MEASURED * (self.total - first)):
            return None
        return (now - begin) / steps * max(0, self.total - done)


def duration_text(seconds: float | None) -> str:
    """Hours, minutes and seconds."""
    if seconds is None:
        return UNKNOWN_TIME
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def bars() -> Progress:
    """A display of progress bars; a bar has the fields ``note`` and ``left``.

    Step, total and time left are always shown; label and note share what room is left, and are cut.
    """
    cut = {"no_wrap": True, "overflow": "ellipsis"}
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
    """Progress of one piece of work as lines, for logs: not more often than every ``LINE_SECONDS``."""

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
        """Print the last state of work that had a note: its bar would stay on a terminal."""
        if self._noted and self._line:
            say(self._line)


class ConsoleReporter(Reporter):
    """Prints messages, and one display with a bar for each piece of work that is in progress.

    The last bar stays on the terminal if it has a note.
    """

    def __init__(self) -> None:
        self._display = bars()

    def say(self, text: str) -> None:
        """Print a finding; brackets in it are shown as they are."""
        say(text, lines=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        warn(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """A progress bar below those that are open already, or lines where there is no terminal."""
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
    """The opened run, on the device of the options (the CPU without such an option), and the console."""
    set_threads(compute.threads)
    reporter = ConsoleReporter()
    return polarguide.open_run(
        run, device=compute.device if isinstance(compute, ComputeOptions) else "cpu", reporter=reporter
    ), reporter
