"""The whole corpus: no traceback, crash, hang, silent acceptance or write outside, and little time and memory."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parent / "fuzz.py"
FEWEST = 400


@pytest.mark.slow
def test_every_mutation_ends_as_it_should() -> None:
    """In a process of its own, which has no threads yet that a fork would lose."""
    done = subprocess.run([sys.executable, str(FUZZ)], capture_output=True, text=True, check=False)
    counted = re.search(r"^(\d+) cases: ", done.stdout, re.MULTILINE)
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    assert counted is not None
    assert int(counted[1]) >= FEWEST
