"""Messages and progress bars of the library on the console."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from polarguide.cli.console import console, warn
from polarguide.progress import Advance, Reporter


class ConsoleReporter(Reporter):
    """Messages and progress bars on the console."""

    def say(self, text: str) -> None:
        """A finding, as a plain sentence."""
        console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """Something the user should know before going on."""
        warn(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None) -> Iterator[Advance]:
        """A progress bar. One with notes stays on the console at the end."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(label, total=total, note="")

            def advance(done: int, *, total: int | None = None, note: str = "") -> None:
                if note:
                    progress.live.transient = False
                    progress.update(task, note=note)
                progress.update(task, completed=done, total=total)

            yield advance


REPORTER = ConsoleReporter()
