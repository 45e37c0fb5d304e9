"""The time of a training: without pauses, in words, and as its reports state it."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from polarguide.capture import Scene
from polarguide.core.progress import Advance, Reporter
from polarguide.runs import callbacks
from polarguide.runs.callbacks import Look, in_words
from polarguide.runs.folder import RunLog
from polarguide.runs.train import train_gaussians
from polarguide.training.loop import TrainingLoop
from polarguide.training.settings import TrainSettings


class Seconds(Reporter):
    """Keeps the sentences, and the seconds of the reports of a training by the number of its steps."""

    def __init__(self) -> None:
        self.said = list[str]()
        self.seconds = dict[int, float]()

    def say(self, text: str) -> None:
        self.said.append(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            if label == "training":
                assert seconds is not None
                self.seconds[done] = seconds

        yield advance


def test_times_in_words() -> None:
    times = [in_words(seconds) for seconds in (3.4, 300, 5400, 7260)]
    assert times == ["3 s", "5 min", "1 h 30 min", "2 h 01 min"]


def test_pauses_of_a_training_do_not_count(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step takes two seconds, and others look for a thousand seconds after each."""
    now = 0.0
    clock = SimpleNamespace(perf_counter=lambda: now, process_time=lambda: now)
    monkeypatch.setattr(callbacks, "time", clock)

    @contextlib.contextmanager
    def watch(trainer: TrainingLoop) -> Iterator[Look]:
        step = trainer.step

        def slow_step() -> object:
            nonlocal now
            now += 2.0
            return step()

        def look(ends: Callable[[], bool]) -> None:
            nonlocal now
            now += 1000.0

        monkeypatch.setattr(trainer, "step", slow_step)
        yield look

    reporter = Seconds()
    train_gaussians(tiny_scene, tmp_path / "run", settings=TrainSettings(20), reporter=reporter, watch=watch)
    assert reporter.seconds == {0: 0.0, 10: 20.0, 20: 40.0}
    assert [line for line in reporter.said if line.startswith("took 40 s")]
    assert RunLog(tmp_path / "run").elapsed()[0] == 40.0
