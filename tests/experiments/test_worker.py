"""The process that does a task: what it imports from, what it refuses, and that it saves its state when stopped."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import msgspec
import pytest

from polarguide.core.options import ComputeOptions, SceneOptions
from polarguide.core.records import decode
from polarguide.experiments.worker import COMMAND, Scoring, Training, encoded
from polarguide.runs.folder import CHECKPOINT, LOG
from polarguide.training.settings import TrainSettings

PATIENCE = 120.0


def training(scene: Path, folder: Path, steps: int = 20) -> Training:
    return Training(
        scene=str(scene),
        folder=str(folder),
        recipe="3dgs",
        settings=TrainSettings(steps, 0),
        reading=SceneOptions(8),
        compute=ComputeOptions(1, "cpu"),
        resume=False,
    )


def work(data: bytes, folder: Path) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(COMMAND, input=data, cwd=folder, capture_output=True, timeout=PATIENCE)


def test_a_task_survives_its_way(tmp_path: Path) -> None:
    for task in (training(tmp_path, tmp_path / "out"), Scoring("run", True, ComputeOptions(2, "cpu"))):
        assert decode(encoded(task), Training | Scoring, "task") == task  # type: ignore[arg-type]


def test_nothing_is_imported_from_the_current_folder(demo_scene: Path, tmp_path: Path) -> None:
    names = ("json", "torch", "safetensors", "msgspec", "numpy", "random", "polarguide", "sitecustomize")
    for name in names:
        (tmp_path / f"{name}.py").write_text(
            "open('imported', 'a').write(__name__ + '\\n')\nraise SystemExit(9)"
        )
    done = work(encoded(training(demo_scene, tmp_path / "run")), tmp_path)
    assert done.stderr.decode() == ""
    assert done.returncode == 0
    assert not (tmp_path / "imported").exists()
    assert (tmp_path / "run" / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"settings": {"steps": "many", "seed": 0}}, "task (settings.steps): expected a whole number"),
        ({"reading": {"transfer": "gamma"}}, "task (reading.transfer): expected"),
        ({"surprise": 1}, "task"),
        ({"type": "dance"}, "task"),
        ({"scene": "no-such-scene"}, "no-such-scene: expected"),
        ({"recipe": "magic"}, "recipe: expected one of"),
    ],
)
def test_a_wrong_task_is_refused_in_one_line(
    demo_scene: Path, tmp_path: Path, change: dict[str, object], said: str
) -> None:
    data = msgspec.to_builtins(training(demo_scene, tmp_path / "run")) | change
    done = work(json.dumps(data).encode(), tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.decode().splitlines()
    assert said in line
    assert not (tmp_path / "run").exists()


def test_what_is_no_task_is_refused(tmp_path: Path) -> None:
    done = work(b"\xff{", tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.decode().splitlines()) == 1


@pytest.mark.slow
def test_a_stopped_training_saves_its_state(demo_scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = subprocess.Popen(COMMAND, stdin=subprocess.PIPE, cwd=tmp_path, stderr=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stderr is not None
    with process.stdin as stdin:
        stdin.write(encoded(training(demo_scene, run, steps=5000)))
    give_up = time.monotonic() + PATIENCE
    while not (run / LOG).exists() and time.monotonic() < give_up:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 130
    with process.stderr as stderr:
        assert stderr.read() == b""
    assert (run / CHECKPOINT).exists()
