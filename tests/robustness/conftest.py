"""One process for all tables of a worker, from which their cases are forked: that of the tests has threads."""

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

import pytest

LONGEST = 800
"""Seconds for a table, on a machine that is busy with others; each takes less than a minute on an idle core."""


def _line(stream: int, seconds: float) -> bytes:
    """A line that a process writes; what there is of it where the process ends, or does not write in time."""
    until, data = time.monotonic() + seconds, b""
    while not data.endswith(b"\n") and select.select([stream], [], [], max(0, until - time.monotonic()))[0]:
        more = os.read(stream, 1 << 16)
        if not more:
            break
        data += more
    return data


@pytest.fixture(scope="session")
def run_table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], list[str]]]:
    """Runs the cases of a table that are marked for it; returns what failed."""
    said = tmp_path_factory.mktemp("corpus") / "said"
    command = [sys.executable, str(Path(__file__).with_name("fuzz.py")), "--serve", "--ci"]
    pipe = subprocess.PIPE
    with open(said, "wb") as errors:
        program = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=errors, start_new_session=True)

    def run(table: str) -> list[str]:
        os.write(program.stdin.fileno(), f"{table}\n".encode())
        line = _line(program.stdout.fileno(), LONGEST)
        assert line.endswith(b"\n"), f"no answer for {table}: {said.read_text(errors='replace')[-5000:]}"
        answer = json.loads(line)
        if not answer["count"] and not answer["mounts"]:
            pytest.skip("only root, or who may have namespaces of users, can mount a small disk")
        assert answer["count"]
        return answer["faults"]

    with program:
        yield run
        program.stdin.close()
        try:
            program.wait(timeout=60)
        except subprocess.TimeoutExpired:
            os.killpg(program.pid, signal.SIGKILL)
            raise
