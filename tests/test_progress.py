"""Reporters: silent by default, printed by the command line."""

from __future__ import annotations

import pytest

from polarguide.cli.progress import ConsoleReporter
from polarguide.progress import SILENT


def test_the_default_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    SILENT.say("a")
    SILENT.warn("b")
    with SILENT.track("c", None) as advance:
        advance(1, total=2, note="d")
    assert capsys.readouterr() == ("", "")


def test_the_console_shows_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ConsoleReporter()
    reporter.say("[bold]view[/] 1")
    reporter.warn("[x] is odd")
    with reporter.track("[y]") as advance:
        advance(1)
        advance(2, total=2, note="[z]")
    out = capsys.readouterr().out
    assert "[bold]view[/] 1\nwarning: [x] is odd\n" in out
