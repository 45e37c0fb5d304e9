"""How often a picture is drawn to say how fast that is."""

from __future__ import annotations

import time
from typing import Any

import pytest

from polarguide.evaluation import evaluate
from polarguide.evaluation.evaluate import frames_per_second

VIEWS: Any = ["a", "b", "c", "d"]


@pytest.mark.parametrize(("most", "calls"), [(10.0, 16), (0.16, 4)])
def test_slow_pictures_are_drawn_less_often(monkeypatch: pytest.MonkeyPatch, most: float, calls: int) -> None:
    monkeypatch.setattr(evaluate, "MINIMUM_SECONDS", 0.0)
    monkeypatch.setattr(evaluate, "MOST_SECONDS", most)
    drawn: list[Any] = []

    def draw(view: Any) -> None:
        time.sleep(0.05)
        drawn.append(view)

    speed = frames_per_second(draw, VIEWS)
    assert speed is None or speed > 0
    if most > 1:
        assert drawn == [*VIEWS, *VIEWS, *VIEWS, *VIEWS]
    else:
        assert drawn[0] == "a"
        assert 2 <= len(drawn) <= calls
