"""Messages and progress bars on the console."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from polarguide.cli.console import console, warn
from polarguide.progress import Advance, Reporter


def bars(memory_seconds: float = 30.0) -> Progress:
    """A display of progress bars; the time left follows from the speed of the last seconds."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        speed_estimate_period=memory_seconds,
    )


class ConsoleReporter(Reporter):
    """What work reports, printed. Bars disappear at the end, but for those with a note."""

    def say(self, text: str) -> None:
        """Print a finding; brackets in it are shown as they are."""
        console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """Print a warning."""
        warn(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """A progress bar."""
        with bars() as progress:
            task = progress.add_task(label, total=total, note="")

            def advance(done: int, *, total: int | None = None, note: str = "") -> None:
                progress.live.transient = not note
                # A note needs the room of the label, and says as much.
                progress.update(
                    task, completed=done, total=total, note=note, description="" if note else label
                )

            yield advance
