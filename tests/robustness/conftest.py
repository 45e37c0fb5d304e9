"""One process for all tables of a worker, from which their cases are forked: this one has threads, which a fork loses."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

LONGEST = 900
"""Seconds for a table, on a machine that is busy with others; each takes less than a minute on an idle core."""


def _line(stream: int, seconds: float) -> bytes:
    """A line that a process writes; what there is of it where the process ends, or does not in time."""
    until, data = time.monotonic() + seconds, b""
    while not data.endswith(b"\n") and select.select([stream], [], [], max(0, until - time.monotonic()))[0]:
        more = os.read(stream, 1 << 16)
        if not more:
            break
        data += more
    return data


@pytest.fixture(scope="session")
def run_table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Runs the cases of a table that are marked for it, and tells how many there were, and what failed."""
    said = tmp_path_factory.mktemp("corpus") / "said"
    command = [sys.executable, str(Path(__file__).with_name("fuzz.py")), "--serve"]
    pipe = subprocess.PIPE
    with open(said, "wb") as errors:
        program = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=errors, start_new_session=True)
    assert program.stdin is not None
    assert program.stdout is not None
    answers = program.stdout.fileno()

    def run(table: str) -> dict[str, Any]:
        program.stdin.write(f"{table}\n".encode())
        program.stdin.flush()
        line = _line(answers, LONGEST)
        assert line.endswith(b"\n"), f"no answer for {table}: {said.read_text(errors='replace')[-5000:]}"
        answer: dict[str, Any] = json.loads(line)
        return answer

    yield run
    program.stdin.close()
    try:
        program.wait(timeout=60)
    except subprocess.TimeoutExpired:
        os.killpg(program.pid, signal.SIGKILL)
        raise
    finally:
        program.stdout.close()
