"""Records that are read back: what is accepted, and what a message names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from polarguide.core.errors import PolarguideError
from polarguide.core.records import LARGEST_RECORD, check_options, decode, read_record, to_json


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
    ("text", "message"),
    [
        ("", "it: expected a JSON file, found broken JSON"),
        ("[" * 100_000, "it: expected a JSON file, found broken JSON"),
        ('{"count": 1, "parts": ' + '[{"size": ' * 5000 + "1" + "}]" * 5000 + "}", "it"),
        ("[]", r"it: expected a JSON object {...}, found \[\]"),
        ("{}", r"it: expected the field count, found none"),
        ('{"counts": 1}', r"it: expected the field count, found only counts"),
        ('{"count": true}', r"it \(count\): expected a whole number, found true"),
        ('{"count": 1.5}', r"it \(count\): expected a whole number, found 1.5"),
        ('{"count": 1, "parts": [{"size": 1}, {"size": 3}]}', r"it \(parts\[1\].size\): expected 0.5 to 2, found 3"),
        ('{"count": 1, "parts": [{"size": 1, "side": 2}]}', r"it \(parts\[0\]\): expected only size, kind, found side"),
        ('{"count": 1, "parts": [{"size": 1, "kind": "cup"}]}', r"kind\): expected ball or box, found \"cup\""),
        ('{"count": 1, "share": "half"}', r"it \(share\): expected a number or null, found \"half\""),
        ('{"count": 1, "share": -1}', r"it \(share\): expected above 0, found -1"),
        ('{"count": 1, "share": NaN}', r"it \(share\): expected above 0, found NaN"),
        ('{"count": 1, "by_name": {"a": NaN}}', r"it \(by_name.a\): expected a finite number, found nan"),
        ('{"count": 1, "share": 1e999}', r"it \(share\): expected a finite number, found inf"),
        ('{"count": 1, "share": 1' + "0" * 400 + "}", r"it \(share\): expected a number of usual size, found 1000"),
        ('{"count": 1, "by_name": {"a": "x"}}', r"it \(by_name\[...\]\): expected a number, found text"),
        ('{"count": 1, "sides": [1]}', r"it \(sides\): expected a list of length 2, found \[1\]"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_place_and_value(text: str, message: str) -> None:
    with pytest.raises(PolarguideError, match=message) as error:
        decode(text.encode(), Record, "it", remedy="Mend it.")
    assert error.value.remedy == "Mend it."
    assert len(str(error.value)) < 10_000


def test_long_values_are_cut() -> None:
    with pytest.raises(PolarguideError) as error:
        decode({"count": "x" * 5000}, Record, "it")
    assert len(str(error.value)) < 300


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.json"):
        with pytest.raises(PolarguideError, match="expected a readable file") as error:
            read_record(path, Record, remedy="Give another.")
        assert error.value.remedy == "Give another."


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (Options(max_steps=0), "--max-steps: expected 1 or more, found 0"),
        (Options(max_steps=True), "--max-steps: expected a whole number, found true"),
        (Options(share=float("inf")), "--share: expected a finite number, found inf"),
    ],
)
def test_options_are_named_as_on_the_command_line(options: Options, message: str) -> None:
    check_options(Options(folder=Path("here")))
    with pytest.raises(PolarguideError, match=message):
        check_options(options)


@pytest.mark.parametrize("depth", [60, 900, 100_000])
def test_what_is_nested_too_deeply_is_refused(depth: int) -> None:
    for data in (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth):
        with pytest.raises(PolarguideError, match="JSON"):
            decode(data, dict[str, Any], "file.json")


def test_a_file_that_no_record_needs_is_not_read(tmp_path: Path) -> None:
    with open(tmp_path / "run.json", "wb") as file:
        file.truncate(LARGEST_RECORD + 1)
    with pytest.raises(PolarguideError, match="more than 64 MiB"):
        read_record(tmp_path / "run.json", dict[str, Any])


def test_names_that_are_no_unicode_come_back(tmp_path: Path) -> None:
    content = {"name": "v\udcff\udcfe", "text": "\u00e9"}
    (tmp_path / "a.json").write_bytes(to_json(content))
    assert read_record(tmp_path / "a.json", dict[str, str]) == content
    assert "\u00e9".encode() in to_json({"text": "\u00e9"})


def test_a_key_that_stands_twice_is_named() -> None:
    with pytest.raises(PolarguideError, match='"b" stands there twice'):
        decode(b'{"a": {"b": 1, "c": 2, "b": 1}}', dict[str, Any], "f.json")
