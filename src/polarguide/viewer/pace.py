"""When a visitor's picture is drawn, and how coarse."""

from __future__ import annotations

REST = 0.25  # seconds without a change after which a picture is drawn sharply
BUDGET = 0.1  # seconds that a picture may take while the camera moves
FIRST_HEIGHT = 360
LEAST_HEIGHT = 90
GREATEST_HEIGHT = 1080


class Pace:
    """Coarse pictures while something changes, one sharp picture once it rests.

    The height of coarse pictures follows the time that they take. Times are seconds of one clock.
    """

    def __init__(self) -> None:
        self._changed = 0.0
        self._version = 1
        self._drawn = self._sharp = 0
        self.last = 0.0
        self._height = float(FIRST_HEIGHT)

    def change(self, now: float) -> None:
        """Something that the picture shows has changed."""
        self._changed = now
        self._version += 1

    def stale(self) -> None:
        """The scene itself has changed: a sharp picture is due, without coarse ones before."""
        self._version += 1

    def wants(self, now: float) -> str | None:
        """``coarse``, ``sharp``, or None where the picture is up to date."""
        if now - self._changed >= REST:
            return None if self._sharp == self._version else "sharp"
        return None if self._drawn == self._version else "coarse"

    def size(self, window: tuple[int, int], kind: str) -> tuple[int, int]:
        """Width and height of the next picture for a window of so many pixels."""
        limit = GREATEST_HEIGHT if kind == "sharp" else round(self._height)
        height = max(1, min(window[1], limit))
        return max(1, round(window[0] * height / max(1, window[1]))), height

    def begin(self) -> int:
        """What is drawn now: to be handed to ``end``."""
        return self._version

    def end(self, version: int, kind: str, seconds: float, now: float) -> None:
        """A picture has been drawn."""
        self._drawn, self.last = version, now
        if kind == "sharp":
            self._sharp = version
            return
        # Time goes with the number of pixels, at most. Too slow is mended at once, room is taken step by step.
        factor = (BUDGET / max(seconds, 1e-4)) ** 0.5
        self._height *= max(0.25, factor) if factor < 1 else min(1.1, factor)
        self._height = min(float(GREATEST_HEIGHT), max(float(LEAST_HEIGHT), self._height))
