"""Every verb that writes, on a disk that is full: see ``full_disk.py``."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "full_disk.py"
NO_MOUNT = 77
FEWEST = 34


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_nothing_is_lost() -> None:
    """In a process of its own, which has no threads yet that a fork would lose, and its own mounts."""
    command = [sys.executable, str(PROGRAM), "--quick", "--shares", "0", "0.6"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == NO_MOUNT:
        pytest.skip("only root, or who may have namespaces of users, can mount a small disk")
    counted = re.search(r"^(\d+) full disks: ", done.stdout, re.MULTILINE)
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    assert counted is not None
    assert int(counted[1]) >= FEWEST
