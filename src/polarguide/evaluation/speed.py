"""Frames a second, measured alone or not at all."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from polarguide.training.stopwatch import Stopwatch

View = TypeVar("View")
MINIMUM_SECONDS = 1.5


def frames_per_second(draw: Callable[[View], object], views: Sequence[View]) -> float | None:
    """Median over views of 1 / seconds for ``draw``, after one warm-up of each; nothing is waited for but the call.

    Args:
        draw: renders one view and returns when it is done.
        views: what to render; each is timed at least three times.

    Returns:
        Frames a second, or None where other work ran on the machine meanwhile.
    """
    for view in views:
        draw(view)
    stopwatch = Stopwatch()
    times: dict[int, list[float]] = {index: [] for index in range(len(views))}
    begin = time.perf_counter()
    while len(times[0]) < 3 or time.perf_counter() - begin < MINIMUM_SECONDS:
        for index, view in enumerate(views):
            start = time.perf_counter()
            draw(view)
            times[index].append(time.perf_counter() - start)
    _, alone = stopwatch.read()
    return 1 / statistics.median(statistics.median(t) for t in times.values()) if alone else None
