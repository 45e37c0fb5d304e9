"""What the command line says of itself."""

from __future__ import annotations

import dataclasses
import inspect
import subprocess
import sys
from typing import get_type_hints

import pytest

from polarguide import __version__
from polarguide.cli.app import VERBS, function_of, options_of, run

# Fields that a verb sets by other options of its own.
ELSEWHERE = {
    *(
        (verb, name)
        for verb in ("compare", "ablate")
        for name in ("seed", "views_per_step", "gaussians", "begin_again", "materials")
    ),
    ("prepare", "calibration"),
    ("prepare", "analyzers"),
    ("measure", "calibration"),
    *((verb, "analyzers") for verb in ("measure", "priors")),
}
HEAVY = ("torch", "scipy", "pycolmap", "cv2", "viser")


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb_names_and_explains_every_flag(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        run([verb, "--help"])
    assert not stop.value.code
    text = capsys.readouterr().out
    function = function_of(verb)
    about = inspect.getdoc(function) or ""
    assert about.splitlines()[0] in text
    kinds = get_type_hints(function)
    for parameter in inspect.signature(function).parameters.values():
        kind, fields, explained = kinds[parameter.name], [parameter.name], about
        if dataclasses.is_dataclass(kind):
            fields = [field.name for field in dataclasses.fields(kind)]
            explained = "\n".join(base.__doc__ or "" for base in kind.__mro__)
            fields = [name for name in fields if (verb, name) not in ELSEWHERE]
        for name in fields:
            if parameter.kind is parameter.KEYWORD_ONLY:
                flag = f"--{name.replace('_', '-')}"
                assert f"{flag} " in text or f"{flag}, --no-" in text, name
            assert f"{name}:" in explained, f"{name} is not explained"
        assert set(fields) <= set(options_of(function))


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["trian"], [], *([verb, "--help"] for verb in VERBS)]
)
def test_help_loads_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys\nfrom polarguide.__main__ import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        f"print('loaded:', *[name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_help_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(["--help"])
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


@pytest.mark.parametrize(
    "arguments", [[], ["train"], ["eval", "run", "--wings", "2"], ["demo", "--steps", "many"]]
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
