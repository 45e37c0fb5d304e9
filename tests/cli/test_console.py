"""What the console shows of names that come from files."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.cli.console import printable

HOSTILE = "\x1b[2J\x1b]0;mine\x07\u202e"


def test_terminals_obey_no_name() -> None:
    assert printable(f"a{HOSTILE}b\n") == r"a\x1b[2J\x1b]0;mine\x07\u202eb\n"
    assert printable("räume, 90°, é\nline", lines=True) == "räume, 90°, é\nline"
    assert printable("\udcff") == r"\udcff"  # of a name that is no UTF-8


def test_errors_show_names_without_their_control_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["eval", str(tmp_path / HOSTILE)]) == 2
    said = capsys.readouterr().err
    assert r"\x1b[2J" in said
    assert "\x1b" not in said
    assert "\u202e" not in said
