"""Frame pacing: decide when a session's picture is rendered, and at which resolution."""

from __future__ import annotations

REST = 0.25  # seconds without a change after which a sharp picture is rendered
BUDGET = 0.1  # seconds per picture while the camera moves
FIRST_HEIGHT = 360
LEAST_HEIGHT = 90
GREATEST_HEIGHT = 1080
GREATEST_WIDTH = 3840


class FramePacing:
    """Coarse pictures while the camera or a control changes, one sharp picture afterwards.

    The height of coarse pictures adapts to the time that they take. Times are seconds of one monotonic clock.
    """

    def __init__(self) -> None:
        self._changed = 0.0
        self._version = 1
        self._drawn = self._sharp = 0
        self.last_frame = 0.0
        self._height = float(FIRST_HEIGHT)

    def mark_changed(self, now: float) -> None:
        """Record that the camera or a control has changed at the time ``now``."""
        self._changed = now
        self._version += 1

    def mark_outdated(self) -> None:
        """Record that the scene has changed: a sharp picture is due, without coarse ones before it."""
        self._version += 1

    def due(self, now: float) -> str | None:
        """The kind of picture that is due: "coarse", "sharp", or None if the last picture is up to date."""
        if now - self._changed >= REST:
            return None if self._sharp == self._version else "sharp"
        return None if self._drawn == self._version else "coarse"

    def frame_size(self, window: tuple[int, int], kind: str) -> tuple[int, int]:
        """Width and height in pixels of the next picture of this kind, given those of the window."""
        limit = GREATEST_HEIGHT if kind == "sharp" else round(self._height)
        height = max(1, min(window[1], limit))
        width = max(1, round(window[0] * height / max(1, window[1])))
        if width > GREATEST_WIDTH:
            height = max(1, round(height * GREATEST_WIDTH / width))
        return min(width, GREATEST_WIDTH), height

    def begin_frame(self) -> int:
        """The version of the scene that is about to be rendered, for ``end_frame``."""
        return self._version

    def end_frame(self, version: int, kind: str, seconds: float, now: float) -> None:
        """Record that a picture was rendered in so many seconds."""
        self._drawn, self.last_frame = version, now
        if kind == "sharp":
            self._sharp = version
            return
        # Time is at most proportional to the number of pixels. Shrink at once, grow step by step.
        factor = (BUDGET / max(seconds, 1e-4)) ** 0.5
        self._height *= max(0.25, factor) if factor < 1 else min(1.1, factor)
        self._height = min(float(GREATEST_HEIGHT), max(float(LEAST_HEIGHT), self._height))
