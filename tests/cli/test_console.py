"""What the console shows of names that come from files, of sizes, and of what has no value."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
from rich.console import Console

from polarguide.cli.app import run
from polarguide.cli.console import say, size_text
from polarguide.cli.evaluate import _errors, _table, _without_value
from polarguide.evaluation.table import METRICS, OBJECT_METRICS, shown_metrics
from polarguide.printable import printable

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


def test_what_has_no_value_is_named_once() -> None:
    record = {metric.key: 1.0 for metric in METRICS} | {"mesh_fscore_1": None, "normal_mae_deg": None}
    assert _without_value(record) == [
        "no ground truth, or no such layer, for: normal error, mesh F-score 1 %"
    ]
    record["mesh_fscore_1_reason"] = "skimage is not installed"
    assert _without_value(record) == ["no ground truth, or no such layer, for: normal error"]
    assert dict(shown_metrics(record))["mesh F-score 1 %"] == "n/a (skimage is not installed)"


def test_a_reason_keeps_its_brackets() -> None:
    record = {metric.key: 1.0 for metric in METRICS} | {"mesh_fscore_1": None}
    record["mesh_fscore_1_reason"] = "pip install 'a[b]'"
    shown = Console(file=io.StringIO(), width=400)
    shown.print(_table(record, "scores"))
    assert "n/a (pip install 'a[b]')" in shown.file.getvalue()  # type: ignore[attr-defined]


def test_lines_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    say(f"trained: o[/red]{HOSTILE}")
    said = capsys.readouterr().out
    assert r"o[/red]\x1b[2J" in said
    assert "\x1b" not in said


def test_objects_of_any_name_are_rows_of_the_table() -> None:
    values = {key: 0.5 for key in OBJECT_METRICS}
    named = {f"[/red]{HOSTILE}": {"pixels": 3, **values}}
    shown = Console(file=io.StringIO(), width=400)
    shown.print(_errors({"objects": named, "materials": {}}))
    assert r"[/red]\x1b[2J" in shown.file.getvalue()  # type: ignore[attr-defined]


def test_a_console_that_cannot_say_a_letter_gets_its_escape(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), "ascii", "strict")
    monkeypatch.setattr(sys, "stdout", stream)
    assert run(["--version"]) == 0
    say("\u2603\udcff")
    stream.flush()
    assert b"\\u2603\\udcff" in stream.buffer.getvalue()  # type: ignore[attr-defined]
