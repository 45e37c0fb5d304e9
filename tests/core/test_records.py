"""Records that are read back: what is accepted, and what a message names."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from faults import Fault
from msgspec import Meta

from polarguide.core.records import (
    LARGEST_RECORD,
    check_options,
    decode,
    first_differing_value,
    read_record,
    to_json,
)


class Part(msgspec.Struct, forbid_unknown_fields=True):
    size: Annotated[float, Meta(ge=0.5, le=2)]
    kind: Literal["box", "ball"] = "box"


class Record(msgspec.Struct):
    count: int
    parts: list[Part] = []
    share: Annotated[float, Meta(gt=0)] | None = None
    by_name: dict[str, float] = {}
    sides: tuple[int, int] = (0, 0)


@dataclass
class Options:
    max_steps: Annotated[int, Meta(ge=1)] = 1
    share: float = 0.0
    folder: Path | None = None


def test_what_is_right_is_read(tmp_path: Path) -> None:
    content = {
        "count": 3,
        "parts": [{"size": 1, "kind": "ball"}],
        "by_name": {"a": 2},
        "more": [float("nan")],
    }
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + to_json(content))  # with the mark that Windows writes
    found = read_record(tmp_path / "a.json", Record)
    assert found == Record(3, [Part(1.0, "ball")], by_name={"a": 2.0})
    del content["more"]
    assert decode(content, dict[str, Any], "it") == content


@pytest.mark.parametrize(
    ("text", "where", "expected", "found"),
    [
        ("", "it", "a JSON file", "broken JSON"),
        ("[" * 100_000, "it", "a JSON file", "broken JSON"),
        ('{"count": 1, "parts": ' + '[{"size": ' * 5000 + "1" + "}]" * 5000 + "}", "it", "", ""),
        ("[]", "it", "a JSON object {...}", "[]"),
        ("{}", "it", "the field count", "none"),
        ('{"counts": 1}', "it", "the field count", "only counts"),
        ('{"count": true}', "it (count)", "a whole number", "true"),
        ('{"count": 1.5}', "it (count)", "a whole number", "1.5"),
        ('{"count": 1, "parts": [{"size": 1}, {"size": 3}]}', "it (parts[1].size)", "0.5 to 2", "3"),
        ('{"count": 1, "parts": [{"size": 1, "side": 2}]}', "it (parts[0])", "only size, kind", "side"),
        ('{"count": 1, "parts": [{"size": 1, "kind": "cup"}]}', "kind)", "ball or box", '"cup"'),
        ('{"count": 1, "share": "half"}', "it (share)", "a number or null", '"half"'),
        ('{"count": 1, "share": -1}', "it (share)", "above 0", "-1"),
        ('{"count": 1, "share": NaN}', "it (share)", "above 0", "NaN"),
        ('{"count": 1, "by_name": {"a": NaN}}', "it (by_name.a)", "a finite number", "nan"),
        ('{"count": 1, "share": 1e999}', "it (share)", "a finite number", "inf"),
        ('{"count": 1, "share": 1' + "0" * 400 + "}", "it (share)", "a number of usual size", "1000"),
        ('{"count": 1, "by_name": {"a": "x"}}', "it (by_name.a)", "a number", '"x"'),
        ('{"count": 1, "sides": [1]}', "it (sides)", "a list of length 2", "[1]"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_place_and_value(
    text: str, where: str, expected: str, found: str
) -> None:
    fault = Fault(where, expected, found, "Mend it.")
    assert len(str(fault.raised_by(decode, text.encode(), Record, "it", remedy="Mend it."))) < 10_000


def test_long_values_are_cut() -> None:
    assert len(str(Fault("it").raised_by(decode, {"count": "x" * 5000}, Record, "it"))) < 300


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.json"):
        fault = Fault(str(path), "a readable file", "", "Give another.")
        fault.raised_by(read_record, path, Record, remedy="Give another.")


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (Options(max_steps=0), Fault("--max-steps", "1 or more", "0")),
        (Options(max_steps=True), Fault("--max-steps", "a whole number", "true")),
        (Options(share=float("inf")), Fault("--share", "a finite number", "inf")),
    ],
)
def test_options_are_named_as_on_the_command_line(options: Options, fault: Fault) -> None:
    check_options(Options(folder=Path("here")))
    fault.raised_by(check_options, options)


@pytest.mark.parametrize("depth", [60, 900, 100_000])
def test_what_is_nested_too_deeply_is_refused(depth: int) -> None:
    for data in (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth):
        Fault("file.json", "JSON").raised_by(decode, data, dict[str, Any], "file.json")


def test_a_file_that_no_record_needs_is_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "run.json", "wb") as file:
        file.truncate(LARGEST_RECORD + 1)
    Fault("run.json", "", "more than 64 MiB").raised_by(read_record, tmp_path / "run.json", dict[str, Any])


def test_names_that_are_no_unicode_come_back(tmp_path: Path) -> None:
    content = {"name": "v\udcff\udcfe", "text": "\u00e9"}
    (tmp_path / "a.json").write_bytes(to_json(content))
    assert read_record(tmp_path / "a.json", dict[str, str]) == content
    assert "\u00e9".encode() in to_json({"text": "\u00e9"})


def test_a_key_that_stands_twice_is_named() -> None:
    twice = b'{"a": {"b": 1, "c": 2, "b": 1}}'
    Fault("f.json", "", '"b"').raised_by(decode, twice, dict[str, Any], "f.json")


@pytest.mark.parametrize(
    ("before", "now", "difference"),
    [
        ({"a": 1}, {"a": 2}, (".a", 1, 2)),
        ({"a": None}, {}, (".a", None, None)),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, (".a.b.1", 2, 3)),
    ],
)
def test_the_first_difference_of_records(before: object, now: object, difference: object) -> None:
    assert first_differing_value("", before, now) == difference
