"""Progress reporting for long operations. Silent by default; the command line installs a reporter."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol


class Advance(Protocol):
    """Records how much of a piece of work is done."""

    def __call__(
        self, done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
    ) -> None:
        """``done`` so far, of ``total`` if that has become known, and a few words about it.

        ``seconds``: on a clock that stands still during pauses; None: there are no pauses.
        """


def _ignore(done: int, *, total: int | None = None, note: str = "", seconds: float | None = None) -> None:
    pass


class Reporter:
    """Where messages and progress go. This one drops them; derive from it to show them."""

    def say(self, text: str) -> None:
        """A finding, as a plain sentence."""

    def warn(self, text: str) -> None:
        """Something the user should know before going on."""

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Progress of one piece of work; yields a function that takes what has been done so far.

        Args:
            label: what is done. total: how much there is to do; None where that is not known yet.
        """
        yield _ignore


SILENT = Reporter()
