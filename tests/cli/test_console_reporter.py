"""What work reports, as the command line prints it."""

from __future__ import annotations

import pytest

from polarguide.cli.progress import ConsoleReporter


def test_the_console_shows_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ConsoleReporter()
    reporter.say("[bold]view[/] 1")
    reporter.warn("[x] is odd")
    with reporter.track("[y]") as advance:
        advance(1)
        advance(2, total=2, note="[z]")
    out = capsys.readouterr().out
    assert "[bold]view[/] 1\nwarning: [x] is odd\n" in out
