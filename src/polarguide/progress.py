"""How long work says what it does; silent unless the command line puts a console behind it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator


class Reporter:
    """Where messages and progress go."""

    def say(self, text: str) -> None:
        """A finding, as a plain sentence."""

    def warn(self, text: str) -> None:
        """Something the user should know before going on."""

    @contextlib.contextmanager
    def track(self, label: str, total: int | None) -> Iterator[Callable[[int], None]]:
        """Progress of one piece of work; yields a function that takes what has been done so far."""
        yield lambda done: None
