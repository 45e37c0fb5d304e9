"""Child processes, with a stand-in for the program that starts fast: failures stay alone, Ctrl-C loses nothing."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from polarguide.cli.job_progress import JobProgress, last_line
from polarguide.experiments import jobs
from polarguide.experiments.jobs import Child, Job, run_jobs

# Says when it begins, does what its first word asks for, and says when it ends.
PROGRAM = """
import pathlib, signal, sys, time
verb, folder = sys.argv[1], pathlib.Path(sys.argv[2])
with open(folder / "did", "a") as did:
    print(verb, *sys.argv[3:], file=did)
if verb == "fail":
    print("a warning\\nerror: " + folder.name + " is broken.\\n", file=sys.stderr)
    sys.exit(2)
if verb in ("wait", "deaf"):
    count = 0
    def asked(*_):
        global count
        count += 1
    signal.signal(signal.SIGINT, asked)
    (folder / "ready").touch()
    end = time.monotonic() + 30
    while (verb == "deaf" or not count) and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.3)
    (folder / "asked").write_text(str(count))
    sys.exit(130)
time.sleep(0.2)
"""


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Job]:
    """Makes a job of the stand-in's verbs."""
    monkeypatch.setattr(jobs, "PROGRAM", (sys.executable, "-S", "-c", PROGRAM))

    def make(name: str, *verbs: str) -> Job:
        folder = tmp_path / name
        return Job(name, folder, tuple((verb, str(folder)) for verb in verbs), 10)

    return make


class Watch:
    """Notes what ``run_jobs`` reports."""

    def __init__(self) -> None:
        self.ended: dict[str, str | None] = {}
        self.most = 0

    def end(self, job: Job, error: str | None) -> None:
        self.ended[job.label] = error

    def look(self, active: Sequence[Child]) -> None:
        self.most = max(self.most, len(active))


def test_a_failure_takes_no_other_job_down(job: Callable[..., Job]) -> None:
    watch = Watch()
    todo = [job("a", "train", "eval"), job("b", "fail", "eval"), job("c", "train")]
    run_jobs(todo, parallel=2, threads=3, on_end=watch.end, on_look=watch.look)
    assert watch.ended == {"a": None, "b": "b is broken.", "c": None}
    assert watch.most == 2
    did = [(j.folder / "did").read_text().split("\n")[:-1] for j in todo]
    assert did == [["train --threads 3", "eval --threads 3"], ["fail --threads 3"], ["train --threads 3"]]


def interrupt_when(ready: Callable[[], bool], times: int = 1) -> threading.Thread:
    """Ctrl-C for this process as soon as something is true, and again a little later."""

    def wait() -> None:
        end = time.monotonic() + 20
        while not ready() and time.monotonic() < end:
            time.sleep(0.02)
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.4)

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_ctrl_c_asks_every_child_once_and_waits(job: Callable[..., Job]) -> None:
    watch, todo = Watch(), [job("a", "wait"), job("b", "wait"), job("c", "wait")]
    thread = interrupt_when(lambda: all((j.folder / "ready").exists() for j in todo[:2]))
    with pytest.raises(KeyboardInterrupt):
        run_jobs(todo, parallel=2, threads=1, on_end=watch.end, on_look=watch.look)
    assert [(j.folder / "asked").read_text() for j in todo[:2]] == ["1", "1"]
    assert not todo[2].folder.exists()
    assert watch.ended == {}
    thread.join()


def test_a_second_ctrl_c_does_not_wait(job: Callable[..., Job]) -> None:
    watch, deaf = Watch(), job("a", "deaf")
    begin = time.monotonic()
    thread = interrupt_when((deaf.folder / "ready").exists, times=2)
    with pytest.raises(KeyboardInterrupt):
        run_jobs([deaf], parallel=1, threads=1, on_end=watch.end, on_look=watch.look)
    assert time.monotonic() - begin < 20
    assert not (deaf.folder / "asked").exists()
    thread.join()


def test_sigterm_acts_like_ctrl_c_and_its_handler_is_put_back(job: Callable[..., Job]) -> None:
    watch, before = Watch(), signal.getsignal(signal.SIGTERM)

    def look(active: Sequence[Child]) -> None:
        if active and (active[0].job.folder / "ready").exists():
            os.kill(os.getpid(), signal.SIGTERM)

    waiting = job("a", "wait")
    with pytest.raises(KeyboardInterrupt):
        run_jobs([waiting], parallel=1, threads=1, on_end=watch.end, on_look=look)
    assert (waiting.folder / "asked").read_text() == "1"
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_last_line_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    assert last_line(log) is None
    log.write_text('{"step": 9}\n' * 1000 + '{"step": 19}\n{"st')
    assert last_line(log) == {"step": 19}
    log.write_text("nonsense\n")
    assert last_line(log) is None


def test_the_display_shows_markup_in_names_as_it_is(
    job: Callable[..., Job], capsys: pytest.CaptureFixture[str]
) -> None:
    odd = job("[red]cup[/]", "eval")
    with JobProgress([odd]) as progress:
        progress.look([])
        progress.ended(odd, "no [bold]space[/] left")
    assert "failed  [red]cup[/]: no [bold]space[/] left" in capsys.readouterr().out
