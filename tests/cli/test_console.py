"""What the console shows: messages, warnings, progress and help."""

import dataclasses
import inspect
import io
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import get_type_hints

import pytest
from rich.console import Console

from polarguide import __version__
from polarguide.cli import console
from polarguide.cli.app import VERBS, function_of, options_of, run
from polarguide.cli.console import (
    UNKNOWN_TIME,
    ConsoleReporter,
    Lines,
    Rate,
    bars,
    say,
    size_text,
    warnings_printed,
)
from polarguide.cli.runs import _errors, print_scores
from polarguide.core.errors import PolarguideWarning
from polarguide.core.text import printable
from polarguide.results.evaluation import table
from polarguide.results.evaluation.table import METRICS, OBJECT_METRICS

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


def test_sizes_of_files() -> None:
    assert [size_text(size) for size in (3, 42_446, 1_000_000, 4_850_000)] == [
        "1 kB",
        "42 kB",
        "1.0 MB",
        "4.8 MB",
    ]


def test_what_has_no_value_is_named_once_and_a_reason_keeps_its_brackets(
    capsys: pytest.CaptureFixture[str],
) -> None:
    record = {metric.key: 1.0 for metric in METRICS} | {"mesh_fscore_1": None, "normal_mae_deg": None}
    print_scores(record | {"objects": {}}, "scores")
    assert "for: normal error, mesh F-score 1 %\n" in capsys.readouterr().out
    record["mesh_fscore_1_reason"] = "pip install 'a[b]'"
    print_scores(record | {"objects": {}}, "scores")
    printed = capsys.readouterr().out
    assert "for: normal error\n" in printed
    assert "n/a (pip install 'a[b]')" in printed


@pytest.mark.parametrize("label", ["[/b]", "[red]", HOSTILE])
def test_labels_and_units_of_plug_ins_are_rows_of_the_table(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, label: str
) -> None:
    plugged = table.Metric("mine", label, label, 1, "lower")
    monkeypatch.setattr(table, "METRICS", (*METRICS, plugged))
    print_scores({"mine": 0.5, "objects": {}}, "scores")
    printed = capsys.readouterr().out
    assert printable(label) in printed
    assert f"0.500 {printable(label)}" in printed
    assert "\x1b" not in printed


def test_lines_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    say(f"trained: o[/red]{HOSTILE}")
    said = capsys.readouterr().out
    assert r"o[/red]\x1b[2J" in said
    assert "\x1b" not in said


def test_objects_of_any_name_are_rows_of_the_table() -> None:
    columns = [metric for metric in METRICS if metric.key in OBJECT_METRICS]
    values = {key: 0.5 for key in OBJECT_METRICS}
    named = {f"[/red]{HOSTILE}": {"pixels": 3, **values}}
    shown = Console(file=io.StringIO(), width=400)
    shown.print(_errors({"objects": named, "materials": {}}, columns))
    assert r"[/red]\x1b[2J" in shown.file.getvalue()  # type: ignore[attr-defined]


def test_a_console_that_cannot_say_a_letter_gets_its_escape(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), "ascii", "strict")
    monkeypatch.setattr(sys, "stdout", stream)
    assert run(["--version"]) == 0
    say("\u2603\udcff")
    stream.flush()
    assert b"\\u2603\\udcff" in stream.buffer.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["gr\u00fcn", "u\u0308", "\u96ea"])
def test_names_are_readable_in_the_c_locale(tmp_path: Path, name: str) -> None:
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "polarguide", "eval", os.fsencode(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, env={**os.environ, **plain}, check=False)
    assert done.returncode == 2
    assert f"/{name}: expected".encode() in done.stderr


def test_the_display_shows_markup_in_names_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ConsoleReporter()
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
    assert "[bold]view[/] 1\nwarning: [x] is odd\n" in capsys.readouterr().out


def test_eighty_columns_hold_step_total_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=80, highlight=False, color_system=None)
    monkeypatch.setattr(console, "console", terminal)
    display = bars()
    task = display.add_task("training stage all of them", total=50000, note="", left=UNKNOWN_TIME)
    display.update(task, completed=100, note="all  loss 0.0312  31,415 Gaussians  step 0.123 s  and more yet")
    terminal.print(display.get_renderable())
    (line,) = [line for line in screen.getvalue().splitlines() if line.strip()]
    assert len(line) <= 80
    assert "100/50000" in line
    assert "-:--:--" in line
    assert "loss 0.0312" in line


def test_without_a_terminal_a_line_every_so_often(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    told = Lines("training", 1000, clock=lambda: now[0])
    for step in range(0, 1001, 10):
        now[0] = step / 10
        told(step, note=f"loss {step}")
    told.close()
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "training 150/1000, 0:01:25 left  loss 150"
    assert len(said) == 7
    assert said[-1] == "training 1000/1000  loss 1000"


@pytest.mark.parametrize("first", [0, 500])
def test_a_constant_rate_tells_the_time_left_from_a_twentieth_on(first: int) -> None:
    """Also of a training that is resumed."""
    rate = Rate(None)
    total = first + 1000
    found = {
        done: rate.left(done, total=total, seconds=40.0 + 0.2 * (done - first))
        for done in range(first, total + 1, 10)
    }
    for done, left in found.items():
        expected = None if done < first + 50 else pytest.approx(0.2 * (total - done))
        assert left == expected, done


def test_lines_tell_no_time_left_before_a_twentieth(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    told = Lines("training", 2000, clock=lambda: now[0])
    for step in range(0, 151, 10):
        now[0] = 3.0 * step
        told(step, seconds=2.0 * step)  # a third of the time was a pause
    said = capsys.readouterr().out.splitlines()
    assert said[8] == "training 90/2000"
    assert said[9] == "training 100/2000, 1:03:20 left"


# Fields that a verb sets by other options of its own.
ELSEWHERE = {
    *(
        (verb, name)
        for verb in ("compare", "ablate")
        for name in ("seed", "gaussians", "begin_again", "materials")
    ),
    ("train", "begin_again"),
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
    assert VERBS[verb].summary == about.partition("\n\n")[0].replace("\n", " ")
    kinds = get_type_hints(function)
    for parameter in inspect.signature(function).parameters.values():
        kind, fields, explained = kinds[parameter.name], [parameter.name], about
        if dataclasses.is_dataclass(kind):
            fields = [field.name for field in dataclasses.fields(kind) if field.init]
            explained = "\n".join(base.__doc__ or "" for base in kind.__mro__)
            fields = [name for name in fields if (verb, name) not in ELSEWHERE]
        for name in fields:
            if parameter.kind is parameter.KEYWORD_ONLY:
                flag = f"--{name.replace('_', '-')}"
                assert f"{flag} " in text or f"{flag}, --no-" in text, name
            assert f"{name}:" in explained, f"{name} is not explained"
        assert set(fields) <= set(options_of(function))


LOADED = """
import contextlib, sys
from polarguide.__main__ import main
for line in sys.argv[1:]:
    sys.argv[1:] = line.split()
    with contextlib.suppress(SystemExit):
        main()
    print("loaded by", line, *[name for name in HEAVY if name in sys.modules])
"""


def test_help_loads_nothing_heavy() -> None:
    lines = ["--help", "--version", "trian", "", *(f"{verb} --help" for verb in VERBS)]
    command = [sys.executable, "-c", f"HEAVY = {HEAVY}{LOADED}", *lines]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = [line for line in done.stdout.splitlines() if line.startswith("loaded by")]
    assert loaded == [f"loaded by {line}" for line in lines]


def test_the_list_of_verbs_loads_none_of_them() -> None:
    """Nor NumPy: the list is what a shell's user waits for."""
    verbs = tuple(verb.module for verb in VERBS.values())
    command = [sys.executable, "-c", f"HEAVY = {(*HEAVY, 'numpy', *verbs)}{LOADED}", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded by --help"


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


def test_a_label_is_no_markup(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(table, "shown_metrics", lambda record: [("[/b] [red]mine", "0.5")])
    monkeypatch.setattr(table, "absent_metrics", lambda record: [])
    print_scores({"objects": {}}, "[/i]")
    shown = capsys.readouterr().out
    assert "[/b] [red]mine" in shown
    assert "[/i]" in shown
