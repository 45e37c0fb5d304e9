"""Which channels of the G-buffer hold what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

COLOR_CHANNELS = (0, 1, 2)
NORMAL_CHANNELS = (3, 4, 5)


@dataclass(frozen=True)
class Layout:
    """Names of a G-buffer's channels.

    The order is always color, normal (if splatted), the shading model's channels, and depth (if splatted). The native
    passes rely on it.

    Attributes:
        widths: number of channels of each name, in the order in which they lie.
    """

    widths: Mapping[str, int]

    def __contains__(self, name: str) -> bool:
        return name in self.widths

    def __iter__(self) -> Iterator[str]:
        return iter(self.widths)

    def first(self, name: str) -> int:
        """The first channel of a name; -1 if there is none."""
        begin = 0
        for other, width in self.widths.items():
            if other == name:
                return begin
            begin += width
        return -1

    def channels(self, name: str) -> slice:
        """The channels of a name.

        Raises:
            KeyError: there are none.
        """
        begin = self.first(name)
        return slice(begin, begin + self.widths[name])
