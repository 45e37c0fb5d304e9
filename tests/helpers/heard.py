"""A reporter that keeps what it is told."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from polarguide.core.progress import Advance, Reporter


class Heard(Reporter):
    """Sentences in ``said``, warnings among them; label, total and progress of each piece of work in ``tracked``."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.tracked: list[tuple[str, int | None, list[int]]] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    warn = say

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        progress: list[int] = []
        self.tracked.append((label, total, progress))

        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            progress.append(done)

        yield advance
