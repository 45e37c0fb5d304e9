"""Messages and progress of long operations. By default they are ignored; the command line shows them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol


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
