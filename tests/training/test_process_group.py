"""Two processes under torchrun: one that is killed takes the other along, and leaves a checkpoint to go on from."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

import polarguide
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.core.system import process_is_alive
from polarguide.runs.folder import CHECKPOINT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds the ranks in /proc"),
]
PATIENCE = 240.0
STEPS = 400


def flags(scene: Path, out: Path) -> list[str]:
    sizes = ["--downscale", "4", "--steps", str(STEPS), "--checkpoint-every", "20", "--threads", "1"]
    return ["train", str(scene), "--out", str(out), "--recipe", "3dgs", *sizes]


def launch(scene: Path, out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone"]
    command += ["-m", "polarguide", *flags(scene, out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def ranks_of(parent: int) -> dict[int, int]:
    """Process by rank."""
    found = {}
    for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        settings = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        found |= {int(s[5:]): int(pid) for s in settings if s.startswith(b"RANK=")}
    return found


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_all_and_the_run_goes_on_alone(
    demo_scene: Path, tmp_path: Path, victim: int
) -> None:
    out = tmp_path / "run"
    process = launch(demo_scene, out)
    give_up = time.monotonic() + PATIENCE
    while not (out / CHECKPOINT).exists() and time.monotonic() < give_up:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    ranks = ranks_of(process.pid)
    assert set(ranks) == {0, 1}
    os.kill(ranks[victim], signal.SIGKILL)
    begin = time.monotonic()
    _, errors = process.communicate(timeout=60)
    assert time.monotonic() - begin < 60
    assert process.returncode != 0
    assert not any(process_is_alive(pid) for pid in ranks.values())
    told = [line for line in errors.splitlines() if line.startswith("error: training: expected 2 processes")]
    assert len(told) == 1, errors
    assert f"rank {victim} (process {ranks[victim]}) was lost" in told[0]
    assert "--resume" in told[0]
    step = int(load_file(out / CHECKPOINT)["scalars"][0])
    assert 0 < step < STEPS
    if victim == 0:
        polarguide.train(
            demo_scene,
            out,
            recipe="3dgs",
            settings=polarguide.TrainSettings(STEPS),
            session=SessionOptions(threads=1),
            reading=SceneOptions(downscale=4),
            resume=True,
        )
        assert int(load_file(out / CHECKPOINT)["scalars"][0]) == STEPS
