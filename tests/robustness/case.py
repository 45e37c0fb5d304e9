"""One case: a change to a copy of the base, a command line, and how the command has to end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

Change = Callable[[], object]
"""Spoils a copy of the base, which is the current folder."""


def nothing() -> None:
    """Leave the base as it is: the command line alone is wrong."""


@dataclass(frozen=True)
class Case:
    """One row of a table.

    Attributes:
        name: what is spoiled, and how.
        change: see ``Change``; where it draws, it draws from ``random``, which is seeded with name and seed.
        command: the command line, as words or as text that is split at blanks; empty: that of the table.
        more: words behind the command.
        passes: why it may end without an error or a warning; empty: it may not.
        where, expected, found: regular expressions for the fields of the error; empty: anything.
        warning, prints: regular expressions for a warning, and for all that is printed; empty: anything.
        check: raises where what was written is not as it should be; called after the command.
        ci: whether ``make test`` runs it; ``make fuzz`` runs all.
        seeds: how many seeds a random change has in a round of ``make fuzz``. seed: that of this case.
    """

    name: str
    change: Change = nothing
    command: str | Sequence[str] = ""
    more: str | Sequence[str] = ""
    passes: str = ""
    where: str = ""
    expected: str = ""
    found: str = ""
    warning: str = ""
    prints: str = ""
    check: Callable[[], object] | None = None
    ci: bool = False
    seeds: int = 0
    seed: int = 0

    @property
    def words(self) -> list[str]:
        """The command line."""
        parts = (part.split() if isinstance(part, str) else list(part) for part in (self.command, self.more))
        return [word for part in parts for word in part]


def table(subject: str, command: str | Sequence[str], *cases: Case, **common: object) -> list[Case]:
    """Cases of one subject, which begins their names; those without a command of their own take this one."""
    return [
        replace(case, name=f"{subject} {case.name}", command=case.command or command, **common)
        for case in cases
    ]


def seeded(cases: Iterable[Case], first: int, rounds: int) -> Iterator[Case]:
    """The cases; random ones with all their seeds."""
    for case in cases:
        for seed in range(first * case.seeds, (first + rounds) * case.seeds) if case.seeds else (0,):
            yield replace(case, seed=seed)
