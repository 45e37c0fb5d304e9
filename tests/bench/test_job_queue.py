"""Jobs on workers: failures stay alone, lost ones go on, Ctrl-C loses nothing, and a child does what it is sent."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from polarguide.core.options import ComputeOptions, SceneOptions
from polarguide.core.progress import Advance, Reporter
from polarguide.core.records import decode
from polarguide.core.system import interrupt
from polarguide.runs.folder import CHECKPOINT, LOG
from polarguide.training.settings import TrainSettings
from polarguide_bench import children, worker
from polarguide_bench.children import COMMAND, Message, Scoring, Training, files_digest
from polarguide_bench.job_queue import (
    MOST_LOSSES,
    Job,
    Workers,
    run_job,
    run_jobs,
    training_progress,
    workers,
)
from polarguide_bench.options import ClusterOptions

# Reads its task, records its start, and behaves as the name of the device requests.
PROGRAM = """
import json, os, pathlib, signal, sys, time
task = json.loads(sys.stdin.readline())["task"]
verb, folder = task["compute"]["device"], pathlib.Path(task["folder"])
with open(folder / "did", "a") as did:
    print(verb, task["compute"]["threads"], os.environ["OMP_NUM_THREADS"], file=did)

begun = len((folder / "did").read_text().splitlines())
if verb == "fail":
    print("a warning\\n" + folder.name + " is broken.\\n", file=sys.stderr)
    sys.exit(2)
if verb == "quiet":
    sys.exit(3)

if verb == "always killed" or verb == "killed" and begun <= 4:
    os.kill(os.getpid(), signal.SIGKILL)
if verb == "preempted" and begun == 1:
    sys.exit(130)

if verb in ("wait", "deaf"):
    (folder / "ready").touch()
    assert sys.stdin.read() == ""
    (folder / "heard").touch()
    while verb == "deaf" and not (folder / "enough").exists():
        time.sleep(0.02)
    (folder / "saved").touch()
    sys.exit(130)
time.sleep(0.2)
"""
STAND_IN = (sys.executable, "-S", "-c", PROGRAM)


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[Workers]:
    """Two workers, whose children are the stand-in."""
    monkeypatch.setattr(children, "COMMAND", STAND_IN)
    with workers(ClusterOptions(), count=2, threads=1, memory=0, gpus=(), reporter=Reporter()) as at:
        yield at


@pytest.fixture
def job(tmp_path: Path) -> Callable[..., Job]:
    """Return a function that makes a job of the stand-in's verbs."""

    def make(name: str, *verbs: str) -> Job:
        folder = tmp_path / name
        tasks = [Scoring(folder=str(folder), speed=False, compute=ComputeOptions(3, verb)) for verb in verbs]  # type: ignore[arg-type]
        return run_job(name, folder, lambda: tuple(tasks), 10)

    return make


class Watch(Reporter):
    """Notes what ``run_jobs`` reports and calls something at each report."""

    def __init__(self, at_report: Callable[[], None] = lambda: None) -> None:
        self.ended: dict[str, str | None] = {}
        self.said: list[str] = []
        self.open: set[str] = set()
        self.most = 0
        self.overall: list[tuple[int, str]] = []
        self._at_report = at_report

    def end(self, job: Job, error: str | None) -> None:
        self.ended[job.label] = error

    def say(self, text: str) -> None:
        self.said.append(text)

    @contextlib.contextmanager
    def track(self, label: str, total: int | None = None) -> Iterator[Advance]:
        self.open.add(label)

        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            assert label in self.open
            self.most = max(self.most, len(self.open) - 1)
            if label == "all":
                self.overall.append((done, note))
            self._at_report()

        yield advance
        self.open.remove(label)


def test_a_failure_takes_no_other_job_down(two: Workers, job: Callable[..., Job]) -> None:
    watch = Watch()
    todo = [job("a", "train", "eval"), job("b", "fail", "eval"), job("c", "quiet")]
    run_jobs(todo, two, reporter=watch, on_end=watch.end)
    assert watch.ended == {"a": None, "b": "b is broken.", "c": "the process ended with status 3"}
    assert set(watch.said) == {"done  a", "failed  b: b is broken.", f"failed  c: {watch.ended['c']}"}
    assert watch.most == 2
    assert watch.open == set()
    assert watch.overall[-1] == (30, "3 of 3 ended")
    did = [(j.folder / "did").read_text().split("\n")[:-1] for j in todo]
    assert did == [["train 3 3", "eval 3 3"], ["fail 3 3"], ["quiet 3 3"]]


@pytest.mark.parametrize(
    ("verb", "losses", "ends"),
    [("killed", 4, True), ("preempted", 1, True), ("always killed", MOST_LOSSES - 1, False)],
)
def test_a_job_that_is_lost_goes_on(
    two: Workers, job: Callable[..., Job], verb: str, losses: int, ends: bool
) -> None:
    watch = Watch()
    run_jobs([job("a", verb), job("b", "eval")], two, reporter=watch, on_end=watch.end)
    assert sum(line.startswith("lost  a") for line in watch.said) == losses
    assert (watch.ended["a"] is None) == ends
    assert watch.ended["b"] is None


def interrupt_when(*conditions: Callable[[], bool]) -> threading.Thread:
    """Ctrl-C for this process as soon as each of the conditions is true, one after another."""

    def wait() -> None:
        end = time.monotonic() + 20
        for condition in conditions:
            while not condition() and time.monotonic() < end:
                time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_workers_survive_a_suspension(two: Workers, job: Callable[..., Job]) -> None:
    """A machine that slept for an hour, or Ctrl-Z and fg."""

    async def sleep(dask_scheduler: Any) -> None:
        for state in dask_scheduler.workers.values():
            state.last_seen -= 3600
        if dask_scheduler.worker_ttl:
            await dask_scheduler.check_worker_ttl()

    two.client.run_on_scheduler(sleep)
    assert two.slots() == 2
    watch = Watch()
    run_jobs([job("a", "eval")], two, reporter=watch, on_end=watch.end)
    assert watch.ended == {"a": None}


def test_ctrl_c_asks_every_child_and_waits(two: Workers, job: Callable[..., Job]) -> None:
    watch, todo = Watch(), [job("a", "wait"), job("b", "wait"), job("c", "wait")]
    thread = interrupt_when(lambda: all((j.folder / "ready").exists() for j in todo[:2]))
    with pytest.raises(KeyboardInterrupt):
        run_jobs(todo, two, reporter=watch, on_end=watch.end)
    assert [(j.folder / "saved").exists() for j in todo] == [True, True, False]
    assert not todo[2].folder.exists()
    assert watch.ended == {}
    thread.join()


def test_a_second_ctrl_c_does_not_wait(two: Workers, job: Callable[..., Job]) -> None:
    deaf = job("a", "deaf")
    begin = time.monotonic()
    thread = interrupt_when((deaf.folder / "ready").exists, (deaf.folder / "heard").exists)
    with pytest.raises(KeyboardInterrupt):
        run_jobs([deaf], two, reporter=Watch())
    assert time.monotonic() - begin < 20
    assert not (deaf.folder / "saved").exists()
    (deaf.folder / "enough").touch()
    thread.join()


def test_an_error_of_the_reporter_leaves_no_child_at_work(two: Workers, job: Callable[..., Job]) -> None:
    waiting = job("a", "wait")

    def fail() -> None:
        if (waiting.folder / "ready").exists():
            raise RuntimeError("no display")

    with pytest.raises(RuntimeError, match="no display"):
        run_jobs([waiting], two, reporter=Watch(fail))
    assert (waiting.folder / "saved").exists()


def test_sigterm_acts_like_ctrl_c(two: Workers, job: Callable[..., Job]) -> None:
    waiting = job("a", "wait")

    def terminate() -> None:
        if (waiting.folder / "ready").exists():
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_jobs([waiting], two, reporter=Watch(terminate))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (waiting.folder / "saved").exists()


def test_the_library_installs_no_signal_handlers(two: Workers, job: Callable[..., Job]) -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    during = []
    watch = Watch(lambda: during.append([signal.getsignal(number) for number in numbers]))
    run_jobs([job("a", "eval")], two, reporter=watch)
    assert during
    assert all(handlers == before for handlers in during)


NO_PROGRESS = (0, "")


def test_progress_is_the_last_row_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    assert training_progress(tmp_path, 30) == NO_PROGRESS
    log.write_text('{"step": 9, "psnr": 20.0}\n{"step": 19, "psnr": 21.0, "gaussians": 1234}\n{"st')
    assert training_progress(tmp_path, 30) == (20, "PSNR 21.0 dB  1,234 Gaussians")
    log.write_text('{"step": 9, "psnr": 20.0}\n')
    assert training_progress(tmp_path, 30) == (10, "PSNR 20.0 dB")
    log.write_text("nonsense\n")
    assert training_progress(tmp_path, 30) == NO_PROGRESS


@pytest.mark.parametrize("text", ["[" * 4000, '{"step": "x"}', '{"step": 1e400}', '{"step": -1}', "{}"])
def test_lines_that_are_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "log.jsonl").write_text(text + "\n")
    assert training_progress(tmp_path, 30) == NO_PROGRESS


def test_a_log_that_is_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.jsonl")
    assert training_progress(tmp_path, 30) == NO_PROGRESS


@pytest.mark.parametrize("name", ["stderr.txt", "log.jsonl"])
def test_nothing_is_written_through_a_link(
    two: Workers, job: Callable[..., Job], tmp_path: Path, name: str
) -> None:
    made, victim = job("a", "eval"), tmp_path / "victim"
    victim.write_text("mine")
    made.folder.mkdir()
    (made.folder / name).symlink_to(victim)
    run_jobs([made], two, reporter=Watch())
    assert victim.read_text() == "mine"


def test_pipes_in_a_runs_folder_end_nothing(two: Workers, job: Callable[..., Job]) -> None:
    made = job("a", "eval")
    made.folder.mkdir()
    for name in ("stderr.txt", "log.jsonl"):
        os.mkfifo(made.folder / name)
    run_jobs([made], two, reporter=Watch())
    assert (made.folder / "did").read_text().startswith("eval")


PATIENCE = 120.0


def training(scene: Path, folder: Path, steps: int = 20) -> Training:
    return Training(
        scene=str(scene),
        folder=str(folder),
        recipe="3dgs",
        settings=TrainSettings(steps, 0),
        reading=SceneOptions(8),
        compute=ComputeOptions(1, "cpu"),
    )


@contextlib.contextmanager
def child(task: Training, folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """Start a child on a task, with its standard input open."""
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(COMMAND, cwd=folder, **pipes) as process:  # type: ignore[call-overload]
        process.stdin.write(Message(task, files_digest(), "").to_line())
        process.stdin.flush()
        yield process


def test_a_task_survives_its_way(tmp_path: Path) -> None:
    for task in (training(tmp_path, tmp_path / "out"), Scoring("run", True, ComputeOptions(2, "cpu"))):
        message = Message(task, "1f", "2e")
        assert decode(message.to_line(), Message, "task") == message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": {"steps": "many", "seed": 0}}, "task (task.settings.steps): expected a whole number"),
        ({"reading": {"transfer": "gamma"}}, "task (task.reading.transfer): expected"),
        ({"surprise": 1}, "task"),
        ({"type": "dance"}, "task"),
        ({"scene": "no-such-scene"}, "no-such-scene: expected"),
        ({"recipe": "magic"}, "recipe: expected one of"),
        ({}, "worker: expected the same code as the command that uses this worker (digest other)"),
    ],
)
def test_a_wrong_task_is_refused_in_one_line(
    demo_scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, object],
    message: str,
) -> None:
    task = msgspec.to_builtins(training(demo_scene, tmp_path / "run")) | change
    files = files_digest() if change else "others"
    assert worker.obey(json.dumps({"task": task, "files": files, "code": "other"}).encode()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_line_that_is_no_task_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker.obey(b"\xff{") == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.slow
def test_a_training_that_nobody_waits_for_saves_its_state(demo_scene: Path, tmp_path: Path) -> None:
    """And imports nothing from the folder in which it was started."""
    run = tmp_path / "run"
    for name in ("json", "torch", "safetensors", "msgspec", "numpy", "random", "polarguide", "sitecustomize"):
        program = "open('imported', 'a').write(__name__ + '\\n')\nraise SystemExit(9)"
        (tmp_path / f"{name}.py").write_text(program)
    with child(training(demo_scene, run, steps=5000), tmp_path) as process:
        give_up = time.monotonic() + PATIENCE
        while not (run / LOG).exists() and time.monotonic() < give_up:
            assert process.poll() is None
            time.sleep(0.02)
        process.stdin.close()  # type: ignore[union-attr]
        assert process.wait(PATIENCE) == 130
        assert process.stderr.read() == b""  # type: ignore[union-attr]
    assert (run / CHECKPOINT).exists()
    assert not (tmp_path / "imported").exists()
