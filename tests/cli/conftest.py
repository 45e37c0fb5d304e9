"""For tests of the command line: refused command lines, and runs that may be changed."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from polarguide.cli.app import run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command line that must be refused in one line; returns it."""

    def run_and_read(*arguments: object) -> str:
        assert run([str(argument) for argument in arguments]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        assert lines[0].startswith("error: ")
        assert lines[0].endswith(".")
        return lines[0]

    return run_and_read


@pytest.fixture
def copy(trained: Path, tmp_path: Path) -> Path:
    """A copy of the training that may be changed."""
    return Path(shutil.copytree(trained, tmp_path / "copy"))
