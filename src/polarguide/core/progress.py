"""Progress of long operations. The default reporter is silent; the command line installs its own."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol


class Advance(Protocol):
    """Function that reports the progress of an operation."""

    def __call__(
        self, done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
    ) -> None:
        """Report the progress.

        Args:
            done: amount of finished work.
            total: amount of all work, if it has become known.
            note: short text about the state.
            seconds: time of the report on a clock that stops during pauses; None: there are no pauses.
        """


def _ignore(done: int, *, total: int | None = None, note: str = "", seconds: float | None = None) -> None:
    pass


class Reporter:
    """Receiver of messages and progress. This class ignores them; derive from it to show them."""

    def say(self, text: str) -> None:
        """Report a result in a plain sentence."""

    def warn(self, text: str) -> None:
        """Report a warning."""

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Report the progress of an operation; yields the function that reports the finished work.

        Args:
            label: name of the operation.
            total: amount of work; None: not known yet.
        """
        yield _ignore


SILENT = Reporter()
