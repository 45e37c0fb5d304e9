"""How long work says what it does; silent unless a console or a notebook stands behind it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Advance = Callable[[int], None]
"""Takes how much of a piece of work is done so far."""


class Reporter:
    """Where messages and progress go. This one is silent; a subclass shows them."""

    def say(self, text: str) -> None:
        """A finding, as a plain sentence."""

    def warn(self, text: str) -> None:
        """Something the user should know before going on."""

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        """Progress of one piece of work; yields a function that takes what has been done so far.

        Args:
            label: what is done. total: how much there is to do; None where that is not known.
        """
        yield lambda done: None


SILENT = Reporter()
