"""Messages and progress of long operations. By default they are ignored; the command line shows them."""

from __future__ import annotations

import contextlib
import html
import sys
import time
from collections.abc import Iterator
from typing import Any, Protocol


class Advance(Protocol):
    """Function that an operation calls to report its progress."""

    def __call__(
        self, done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
    ) -> None:
        """Report the progress.

        Args:
            done: amount of finished work.
            total: total amount of work, if it is known now.
            note: short text about the state.
            seconds: time of the report on a clock that stops during pauses. None means that there are no pauses.
        """


def _ignore(done: int, *, total: int | None = None, note: str = "", seconds: float | None = None) -> None:
    pass


class Reporter:
    """Receiver of messages and progress. This base class ignores them; a subclass can show them."""

    def say(self, text: str) -> None:
        """Report a result as a sentence."""

    def warn(self, text: str) -> None:
        """Report a warning."""

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Report the progress of an operation. The context yields the function that reports finished work.

        Args:
            label: name of the operation.
            total: total amount of work, or None if it is not known yet.
        """
        yield _ignore


SILENT = Reporter()


UPDATE_SECONDS = 0.2
"""Least time between two updates of a progress bar in a notebook, in seconds."""


class NotebookReporter(Reporter):
    """Reporter that prints messages in a notebook, and displays a progress bar for each operation.

    Args:
        display: function that displays an object in the notebook and returns a handle with the method ``update``.
        page: function that makes a displayable object from HTML.
    """

    def __init__(self, display: Any, page: Any) -> None:
        self._display = display
        self._page = page

    def say(self, text: str) -> None:
        """Print a result."""
        print(text)

    def warn(self, text: str) -> None:
        """Print a warning."""
        print(f"warning: {text}")

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Display a progress bar, and remove it at the end of the context."""
        handle = self._display(self._page(html.escape(label)), display_id=True)
        most = total
        updated = 0.0

        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            nonlocal most, updated
            most = total or most
            if time.monotonic() - updated < UPDATE_SECONDS:
                return
            updated = time.monotonic()
            count = f"{done:,}" if most is None else f"{done:,} of {most:,}"
            bar = f"<progress value={done} max={most}></progress> " if most else ""
            handle.update(self._page(f"{bar}{html.escape(f'{label}: {count}  {note}')}"))

        try:
            yield advance
        finally:
            handle.update(self._page(""))


def notebook_reporter() -> Reporter:
    """Return a reporter for the notebook that runs this code, or a silent reporter outside of notebooks."""
    ipython: Any = sys.modules.get("IPython")
    if ipython is None or getattr(ipython.get_ipython(), "kernel", None) is None:
        return SILENT
    return NotebookReporter(ipython.display.display, ipython.display.HTML)
