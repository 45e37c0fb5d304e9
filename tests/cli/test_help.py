"""What the command line says of itself."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

from polarguide import __version__
from polarguide.cli.app import VERBS, run


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb_names_and_explains_every_flag(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        run([verb, "--help"])
    assert not stop.value.code
    text = capsys.readouterr().out
    about = inspect.getdoc(VERBS[verb]) or ""
    assert about.splitlines()[0] in text
    for parameter in inspect.signature(VERBS[verb]).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            flag = f"--{parameter.name.replace('_', '-')}"
            assert f"{flag} " in text or f"{flag}, --no-" in text, parameter.name
        assert f"{parameter.name}:" in about, f"{parameter.name} is not explained"


def test_help_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(["--help"])
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["train"], ["eval", "run", "--wings", "2"], ["demo", "--steps", "many"]]
)
def test_what_cannot_be_parsed_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(arguments)
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert "Traceback" not in printed.err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"polarguide {__version__}\n"


def test_python_m_and_its_exit_status() -> None:
    command = [sys.executable, "-m", "polarguide", "eval", "no-such-run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: no-such-run: expected a run folder")
