"""What the console shows of messages and progress."""

from __future__ import annotations

import warnings

import pytest

from polarguide.cli.console import warnings_printed
from polarguide.cli.job_progress import JobReporter
from polarguide.cli.progress import ConsoleReporter
from polarguide.errors import PolarguideWarning


def test_the_display_shows_markup_in_names_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = JobReporter()
    with reporter.track("all", 2) as everything, reporter.track("[red]cup[/]", 1) as one:
        one(1, note="[bold]scoring[/]")
        everything(1)
        reporter.say("failed  [red]cup[/]: no [bold]space[/] left")
    with reporter.track("again"):
        pass
    assert "failed  [red]cup[/]: no [bold]space[/] left" in capsys.readouterr().out


def test_a_bar_with_a_note_stays(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ConsoleReporter()
    with reporter.track("reading", 2) as advance:
        advance(2)
    with reporter.track("training", 2) as advance:
        advance(2, note="[red]loss[/] 0.1")
    said = capsys.readouterr().out
    assert "reading" not in said
    assert "[red]loss[/] 0.1" in said


def test_warnings_of_the_library_are_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with warnings_printed():
        warnings.warn("the [scene] has changed", PolarguideWarning, stacklevel=1)
    assert capsys.readouterr().out == "warning: the [scene] has changed\n"


def test_the_console_shows_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ConsoleReporter()
    reporter.say("[bold]view[/] 1")
    reporter.warn("[x] is odd")
    with reporter.track("[y]") as advance:
        advance(1)
        advance(2, total=2, note="[z]")
    out = capsys.readouterr().out
    assert "[bold]view[/] 1\nwarning: [x] is odd\n" in out
