"""The console: messages, warnings and progress, as bars on a terminal and as lines anywhere else."""

from __future__ import annotations

import contextlib
import importlib
import re
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

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


def use_threads(threads: int) -> None:
    """Let our kernels, torch and OpenCV use this many threads; 0 leaves their defaults."""
    if threads:
        importlib.import_module("polarguide.raster").use_threads(threads)
        importlib.import_module("cv2").setNumThreads(threads)


LINE_SECONDS = 15.0
"""Between two lines of progress where there is no terminal."""
SPEED_SECONDS = 180.0
"""The speed of so long tells the time left: of a training whose pictures grow, the steps of the beginning are cheap."""


class _RemainingTime(TimeRemainingColumn):
    """The time left as the work itself says, or by its speed."""

    def render(self, task: Task) -> Text:
        """A time as of the superclass."""
        left = task.fields.get("left")
        return super().render(task) if left is None else Text(_clock(left), style="progress.remaining")


def _clock(seconds: float) -> str:
    """Hours, minutes and seconds."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


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
        _RemainingTime(table_column=Column(no_wrap=True)),
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
        self._progress: deque[tuple[float, int]] = deque()  # when how much was done, about once a second
        self._line = ""

    def __call__(
        self, done: int, *, total: int | None = None, note: str = "", left: float | None = None
    ) -> None:
        """See ``core.progress.Advance``."""
        now = self._clock()
        self._total = total or self._total
        if not self._progress or now - self._progress[-1][0] >= 1:
            self._progress.append((now, done))
        while len(self._progress) > 2 and now - self._progress[1][0] >= SPEED_SECONDS:
            self._progress.popleft()
        begin, first = self._progress[0]  # a training that goes on does not begin at 0
        finished = self._total is not None and done >= self._total
        if left is None and self._total is not None and done > first:
            left = (now - begin) * (self._total - done) / (done - first)
        time_left = "" if left is None or finished else f", {_clock(left)} left"
        of = "" if self._total is None else f"/{self._total}"
        self._line = f"{self._label} {done}{of}{time_left}" + (f"  {note}" if note else "")
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
    """Prints what an operation reports. Bars disappear at the end, except those with a note."""

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
            task = progress.add_task(label, total=total, note="", left=None)

            def advance(
                done: int, *, total: int | None = None, note: str = "", left: float | None = None
            ) -> None:
                progress.live.transient = not note
                progress.update(task, completed=done, total=total, note=note, left=left)

            yield advance


@contextlib.contextmanager
def lines(label: str, total: int | None) -> Iterator[Advance]:
    """Progress as lines; the last one is printed where the work had a note."""
    printer = Lines(label, total)
    noted = False

    def advance(done: int, *, total: int | None = None, note: str = "", left: float | None = None) -> None:
        nonlocal noted
        noted = bool(note)
        printer(done, total=total, note=note, left=left)

    try:
        yield advance
    finally:
        printer.close(last=noted)


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
        task = self._progress.add_task(label, total=total, note="", left=None)

        def advance(
            done: int, *, total: int | None = None, note: str = "", left: float | None = None
        ) -> None:
            self._progress.update(task, completed=done, total=total, note=note, left=left)

        try:
            yield advance
        finally:
            self._progress.remove_task(task)
            self._open -= 1
            if not self._open:
                self._progress.stop()


if TYPE_CHECKING:
    from polarguide import Run

RunFolder = Annotated[Path, tyro.conf.Positional]


def opened(run: Path, compute: ThreadOptions) -> tuple[Run, ConsoleReporter]:
    """The opened run, on the device of the options (the CPU without such an option), and the console."""
    use_threads(compute.threads)
    reporter = ConsoleReporter()
    device = compute.device if isinstance(compute, ComputeOptions) else "cpu"
    return polarguide.open_run(run, device=device, reporter=reporter), reporter
