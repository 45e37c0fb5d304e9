"""A training that is killed without warning goes on from its last checkpoint to the same result."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

from polarguide.runs.folder import CHECKPOINT

pytestmark = pytest.mark.slow
PATIENCE = 120.0


def launch(scene: Path, out: Path, recipe: str, steps: int, *flags: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "polarguide", "train", str(scene), "--out", str(out)]
    command += ["--recipe", recipe, "--downscale", "4", "--steps", str(steps)]
    command += ["--checkpoint-every", str(steps // 10), "--threads", "1", *flags]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(("recipe", "steps"), [("polarguide-stokes", 200), ("gnerp", 30)])
def test_killed_and_resumed_is_uninterrupted(
    demo_scene: Path, tmp_path: Path, recipe: str, steps: int
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = launch(demo_scene, killed, recipe, steps)
    give_up = time.monotonic() + PATIENCE
    while not (killed / CHECKPOINT).exists() and time.monotonic() < give_up:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "it ended before it could be killed"
    step = int(load_file(killed / CHECKPOINT)["scalars"][0])
    assert 0 < step < steps
    for out, flags in ((killed, ("--resume",)), (whole, ())):
        process = launch(demo_scene, out, recipe, steps, *flags)
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, errors
    first, second = load_file(killed / CHECKPOINT), load_file(whole / CHECKPOINT)
    assert set(first) == set(second)
    assert [n for n in first if first[n].numpy().tobytes() != second[n].numpy().tobytes()] == []
