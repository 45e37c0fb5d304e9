"""Large values of a view that are made when they are read: decoded from files, or computed from other pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Latest:
    """Room for one value: the last one that any of the loaders which share it made."""

    def __init__(self) -> None:
        self.kept: tuple[object, Any] | None = None


class Loader(Generic[T]):
    """Makes a value when it is called.

    Views are worked on one after the other, and each is read several times. So the last value stays in ``latest``, and
    those of all other views take no memory.

    Args:
        make: makes the value. latest: shared by all loaders of a scene.
        derived: whether ``make`` calls another loader of ``latest``, which clears it where it has to.
    """

    def __init__(self, make: Callable[[], T], latest: Latest, *, derived: bool = False) -> None:
        self._make, self._latest, self._derived = make, latest, derived

    def __call__(self) -> T:
        """The value."""
        kept = self._latest.kept
        if kept is not None and kept[0] is self:
            return kept[1]
        del kept  # so that its memory can be taken for the next
        if not self._derived:
            self._latest.kept = None
        value = self._make()
        self._latest.kept = self, value
        return value

    def then(self, change: Callable[[T], T]) -> Loader[T]:
        """A loader of the value after a change."""
        return Loader(lambda: change(self()), self._latest, derived=True)
