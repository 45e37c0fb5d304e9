"""Command lines and Python code in forks of one process of another environment: a start takes seconds, a fork none.

``python served_commands.py`` reads a line of JSON for each, ``{"folder": ..., "words": [...]}`` or ``{"folder": ...,
"code": ...}``, and answers with one, ``{"status": ..., "text": ...}``: the exit status, and all that was printed.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robustness"))

from forked import run  # isort: skip
from warm import import_all  # isort: skip

PATIENCE = 900.0
"""Seconds for one command: a busy machine is slow."""


def command(words: list[str]) -> Callable[[], int]:
    """What the program does with a command line."""

    def act() -> int:
        sys.argv = words
        try:
            importlib.import_module("polarguide.__main__").main()
        except SystemExit as ended:
            return ended.code if isinstance(ended.code, int) else bool(ended.code)
        return 0

    return act


def program(code: str) -> Callable[[], int]:
    """What ``python -W error -c`` does with code."""

    def act() -> int:
        warnings.simplefilter("error")
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
        return 0

    return act


def without_input(act: Callable[[], int]) -> Callable[[], int]:
    """The same, in a process that nobody types into."""

    def acted() -> int:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        return act()

    return acted


def main() -> None:
    """Answer until there are no more lines."""
    answers = os.dup(1)
    os.dup2(2, 1)  # what is printed is no answer
    import_all()
    with tempfile.TemporaryDirectory() as folder:
        for line in sys.stdin:
            asked = json.loads(line)
            os.chdir(asked["folder"])
            act = command(asked["words"]) if "words" in asked else program(asked["code"])
            done = run(without_input(act), Path(folder) / "said", PATIENCE)
            os.write(answers, json.dumps({"status": done.status, "text": done.text}).encode() + b"\n")


if __name__ == "__main__":
    main()
