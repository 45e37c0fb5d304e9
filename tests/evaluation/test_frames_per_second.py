"""How often a picture is drawn to say how fast that is."""

from __future__ import annotations

from typing import Any

import pytest

from polarguide.evaluation import evaluate
from polarguide.evaluation.evaluate import frames_per_second

VIEWS: Any = ["a", "b", "c", "d"]


class Clock:
    """Time that passes only while a view is drawn, half a second for each but the slower first one."""

    def __init__(self) -> None:
        self.now, self.drawn = 0.0, list[Any]()

    def draw(self, view: Any) -> None:
        self.drawn.append(view)
        self.now += 0.75 if view == "a" else 0.5

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(evaluate, "time", found)
    monkeypatch.setattr(evaluate.Stopwatch, "read", lambda self: (found.now, True))
    return found


@pytest.mark.parametrize(
    ("least", "most", "drawn", "speed"),
    [
        (0.0, 40.0, VIEWS * 4, 2.0),  # a warm-up, and three times each
        (10.0, 40.0, VIEWS * 6, 2.0),  # until it has taken long enough
        (0.0, 2.9, ["a", *VIEWS[:3]], 2.0),  # those that fit, once
        (0.0, 0.1, ["a", "a"], 1 / 0.75),
    ],
)
def test_slow_pictures_are_drawn_less_often(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, least: float, most: float, drawn: list[str], speed: float
) -> None:
    monkeypatch.setattr(evaluate, "MINIMUM_SECONDS", least)
    monkeypatch.setattr(evaluate, "MOST_SECONDS", most)
    assert frames_per_second(clock.draw, VIEWS) == pytest.approx(speed)
    assert clock.drawn == drawn


def test_beside_other_work_there_is_no_speed(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate.Stopwatch, "read", lambda self: (clock.now, False))
    assert frames_per_second(clock.draw, VIEWS) is None
