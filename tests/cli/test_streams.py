"""The command under a shell: closed or full streams, folders that go away, kills, limits of memory, empty names."""

import contextlib
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

from polarguide.cli import app
from polarguide.cli.app import run
from polarguide.core.system import interrupt
from polarguide.runs import train as trained
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION
from polarguide.runs.memory_plan import MemoryPlan

PROGRAM = f"{sys.executable} -m polarguide"


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of a shell."""
    return subprocess.run(
        ["bash", "-c", line], cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_help_into_nothing(closed: str, tmp_path: Path) -> None:
    done = shell(f"{PROGRAM} --help {closed}", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("lost", [False, True])
def test_a_signal_that_a_package_makes_another_error_of_ends_the_command(
    lost: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> int:
        try:
            interrupt(signal.SIGINT, None)
        except KeyboardInterrupt as first:
            raise RuntimeError("error encountered (see above)") from (None if lost else first)
        return 0

    monkeypatch.setattr(app, "call", stopped)
    assert run(["eval", "run"]) == 130
    assert "stopped." in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, which takes nothing")
def test_an_error_that_nobody_can_be_told_is_one_still(tmp_path: Path) -> None:
    assert shell(f"{PROGRAM} eval nowhere 2> /dev/full", tmp_path).returncode == 2


def test_a_current_folder_that_is_no_more_is_one_line(tmp_path: Path) -> None:
    done = shell(f"mkdir gone; cd gone; rmdir ../gone; {PROGRAM} eval ../run", tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: the current folder: expected an existing folder")


@pytest.mark.parametrize(
    "words",
    [["train", "scene", "--out=?"], ["train", "scene", "--out", "?"], ["train", "?", "--out", "x"], ["eval", "?"],
     ["measure", "a", "?", "--out", "x"], ["prepare", "a", "--out", "x", "--dark-frame=?"],
     ["share", "run", "--out", "?"], ["priors", "a", "--out=?"], ["compare", "?", "--recipes", "3dgs", "--out", "x"],
     ["render", "run", "--out", "?"], ["export", "run", "--out=?"], ["demo", "--out", "?"]],
)  # fmt: skip
@pytest.mark.parametrize(("name", "found"), [("", "an empty one"), ("a\0b", "a null byte")])
def test_what_names_nothing_is_not_the_current_folder(
    words: list[str],
    name: str,
    found: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run([word.replace("?", name) for word in words]) == 2
    assert f"expected the name of a file or folder, found {found}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "words"),
    [(MemoryError(), "memory: expected enough"), (RuntimeError("can't start new thread"), "memory: expected enough"),
     (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "memory: expected enough"),
     (ImportError("libx.so: failed to map segment from shared object"), "packages: expected installed ones")],
)  # fmt: skip
def test_a_machine_without_room_is_one_line(
    error: Exception, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", fail)
    assert run(["eval", "run"]) == 2
    assert words in capsys.readouterr().err


FULL = """
import resource, sys
from polarguide.cli import app

def fill(*_):
    size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (64 << 20), resource.RLIM_INFINITY))
    held = []
    for piece in (1 << 20, 1 << 10):
        try:
            while True:
                held.append(bytearray(piece))
        except MemoryError as error:
            last = error
    raise last

app.call = fill
sys.exit(app.run(["eval", "run"]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="it limits the address space as Linux does")
def test_memory_that_a_command_holds_is_free_again_for_the_line_that_says_so() -> None:
    ended = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 2, ended.stderr
    (line,) = ended.stderr.splitlines()
    assert line.startswith("error: memory: expected enough of it")


@pytest.mark.parametrize("error", [RuntimeError("a fault of ours"), ModuleNotFoundError("no such module")])
def test_faults_of_ours_are_not_hidden(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", fail)
    with pytest.raises(type(error)):
        run(["eval", "run"])


def test_a_package_that_fails_while_it_is_imported_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "failing_package.py").write_text("raise ValueError('Unknown setting of ITS_VARIABLE')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(app, "call", lambda *_: importlib.import_module("failing_package"))
    assert run(["eval", "run"]) == 2
    assert "Unknown setting of ITS_VARIABLE. Check the environment's variables" in capsys.readouterr().err


def test_a_signal_that_comes_while_a_package_is_imported_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> int:
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(app, "call", stopped)
    assert run(["eval", "run"]) == 130
    assert "stopped." in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device -> a system with /dev/full")
def test_a_version_that_cannot_be_written_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert run(["--version"]) == 2
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()


pytestmark = pytest.mark.slow
PATIENCE = 120.0


def training(scene: Path, out: Path, recipe: str, steps: int, *flags: str) -> list[str]:
    """A command line."""
    command = ["train", str(scene), "--out", str(out), "--recipe", recipe, "--downscale", "4"]
    return [*command, "--steps", str(steps), "--checkpoint-every", str(steps // 10), "--threads", "1", *flags]


def test_killed_and_resumed_is_uninterrupted(demo_scene: Path, tmp_path: Path) -> None:
    recipe = "polarguide-stokes"
    steps = 60
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = subprocess.Popen(
        [sys.executable, "-m", "polarguide", *training(demo_scene, killed, recipe, steps)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    give_up = time.monotonic() + PATIENCE
    while not (killed / CHECKPOINT).exists() and time.monotonic() < give_up:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "it ended before it could be killed"
    assert 0 < int(load_file(killed / CHECKPOINT)["scalars"][0]) < steps
    for out, flags in ((killed, ("--resume",)), (whole, ())):
        assert run(training(demo_scene, out, recipe, steps, *flags)) == 0
    first, second = load_file(killed / CHECKPOINT), load_file(whole / CHECKPOINT)
    assert set(first) == set(second)
    assert [n for n in first if first[n].numpy().tobytes() != second[n].numpy().tobytes()] == []


SHORT = ("--downscale", "4", "--steps", "30", "--threads", "1")


def test_too_little_is_refused_before_a_picture_is_decoded(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object) -> None:
        raise AssertionError("a picture was decoded")

    monkeypatch.setattr("polarguide.capture.view_reader.decode_picture", decode)
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "run"), *SHORT, "--memory", "30MB"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--memory: expected at least" in said
    assert "Use --memory" in said
    assert not (tmp_path / "run").exists()


def test_a_training_in_little_memory_gives_the_same_bits_and_says_what_it_takes(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "a"), *SHORT]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(r"took \d+ s and [\d.]+ GB of memory \(planned: up to [\d.]+ GB\)", said)
    # Nothing is kept in memory.
    monkeypatch.setattr(trained, "plan_memory", lambda *_, **__: MemoryPlan(False, 0, 10**9))
    assert run(["train", str(demo_scene), "--out", str(tmp_path / "b"), *SHORT, "--memory", "3GB"]) == 0
    first, second = (load_file(tmp_path / name / CHECKPOINT) for name in "ab")
    assert first.keys() == second.keys()
    assert all(first[name].numpy().tobytes() == second[name].numpy().tobytes() for name in first)
    assert {path.name for path in (tmp_path / "b").iterdir()} == {
        path.name for path in (tmp_path / "a").iterdir()
    }
    settings = json.loads((tmp_path / "b" / CONFIGURATION).read_text())["settings"]
    assert settings["steps"] == 30
    assert settings["gaussians"] > 100
