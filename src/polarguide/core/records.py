"""Records that are read back from JSON: validated by msgspec, with the file and the value found in every message."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file

T = TypeVar("T")
CORRECT = "Correct or remove the file."
_WORDS = {
    "array": "a list", "bool": "true or false", "float": "a number", "int": "a whole number", "null": "null",
    "object": "a JSON object {...}", "str": "text",
}  # fmt: skip
_DEEPEST = 50
LARGEST_RECORD = 1 << 26
"""Bytes of a JSON file; what they decode to takes some twenty times as much."""
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")


def read_record(path: Path, kind: type[T], *, remedy: str = CORRECT) -> T:
    """A record from a JSON file.

    Args:
        path: the file. kind: a type that msgspec knows: a ``Struct``, a dataclass, ``dict[str, Any]``, ...
        remedy: what to do about a file that is wrong.

    Raises:
        PolarguideError: the file cannot be read, or ``decode`` rejects it.
    """
    return decode(read_file(path, largest=LARGEST_RECORD, remedy=remedy), kind, path, remedy=remedy)


def decode(data: bytes | Any, kind: type[T], where: object, *, remedy: str = CORRECT) -> T:
    """A record from JSON.

    Numbers have to be finite, true and false are no numbers, and no key may stand twice. Keys that a type does not
    have are passed over, unless it forbids them.

    Args:
        data: JSON text as bytes, or what JSON text has been parsed to.
        kind: a type that msgspec knows.
        where: the file or flag, for messages. remedy: what to do about data that is wrong.

    Raises:
        PolarguideError: the data are not JSON, or not of this type; the message names the field and the value.
    """
    value = parse(data, where, remedy=remedy) if isinstance(data, bytes) else data
    try:
        _require_shallow(value)
        record = msgspec.convert(value, kind)
    except PolarguideError as error:  # of a type's own check
        place = f"{where} ({error.where})"
        raise PolarguideError(place, expected=error.expected, found=error.found, remedy=remedy) from None
    except msgspec.ValidationError as error:
        field, expected, found = _fault(str(error), value, kind)
        raise PolarguideError(
            f"{where} ({field})" if field else where, expected=expected, found=found, remedy=remedy
        ) from None
    except (ValueError, RecursionError, OverflowError) as error:
        raise PolarguideError(
            where, expected="a JSON file", found=f"broken JSON ({error})", remedy=remedy
        ) from None
    _require_finite(msgspec.to_builtins(record, enc_hook=str), where, remedy)
    return record


def parse(data: bytes, where: object, *, remedy: str = CORRECT) -> Any:
    """The values of JSON text, of any type. NaN and infinity are let through: ``decode`` checks the fields of a type.

    Raises:
        PolarguideError: the data are not JSON, or a key stands there twice.
    """
    try:
        value = json.loads(data, object_pairs_hook=_each_once)
        _require_shallow(value)
    except (ValueError, RecursionError) as error:
        found = f"broken JSON ({error})"
        raise PolarguideError(where, expected="a JSON file", found=found, remedy=remedy) from None
    return value


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; JSON leaves open which of two values of one key holds, and programs differ.

    Raises:
        ValueError: a key stands there twice.
    """
    record = dict(pairs)
    if len(record) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(
            f"{shortened(next(key for key in record if keys.count(key) > 1))} stands there twice"
        )
    return record


def _require_shallow(value: Any) -> None:
    """Refuse lists in lists in lists, which take more of the stack than there is.

    Raises:
        RecursionError: the lists are nested more deeply than any record of ours.
    """
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            item
            for outer in level
            for item in (
                outer.values() if isinstance(outer, dict) else outer if isinstance(outer, list) else ()
            )
            if isinstance(item, dict | list)
        ]
        if not level:
            return
    raise RecursionError(f"nested more than {_DEEPEST} deep")


def option_name(field: str) -> str:
    """The command line's option that sets a field."""
    return "--" + field.replace("_", "-")


def check_options(options: Any, name: Callable[[str], str] = option_name) -> None:
    """Check the values of a dataclass against its annotations.

    Args:
        options: the dataclass. name: what messages call a field.

    Raises:
        PolarguideError: one has another type or is out of range.
    """
    remedy = "Correct the value."
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    for field, value in values.items():
        _require_finite(value, name(field), remedy)
    try:
        msgspec.convert(values, type(options), dec_hook=lambda kind, value: kind(value))
    except msgspec.ValidationError as error:
        field, expected, found = _fault(str(error), values, type(options))
        raise PolarguideError(
            name(field.partition("[")[0]), expected=expected, found=found, remedy=remedy
        ) from None


def to_json(content: Any) -> bytes:
    """A record as the text of a JSON file; names of files that are no Unicode become escapes in it."""
    try:
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()
    except UnicodeEncodeError:
        return (json.dumps(content, indent=1) + "\n").encode()


def _fault(message: str, value: Any, kind: Any) -> tuple[str, str, str]:
    """Field, what was expected there and what was found, from a message of msgspec's."""
    what, _, path = message.partition(" - at `$")
    what, _, got = what.partition(", got ")
    path = path.rstrip("`")
    form: Any = msgspec.inspect.type_info(kind)
    for name, index in _STEP.findall(path):
        value = _at(value, name, index)
        form = _form_at(form, name, index)
    field = path.lstrip(".")
    expected = _plain(what.removeprefix("Expected "))
    value_found = shortened(value)
    if value is _UNKNOWN:
        value_found = _plain(got) or "another"
    if what.startswith("Object contains unknown field"):
        fields = [field for kind in _kinds(form) for field in getattr(kind, "fields", ())]
        expected = f"only {', '.join(field.encode_name for field in fields)}"
        value_found = what.partition("`")[2].rstrip("`")
    elif what.startswith("Object missing required field"):
        expected = f"the field {what.partition('`')[2].rstrip('`')}"
        value_found = f"only {', '.join(value)}" if isinstance(value, dict) and value else "none"
    elif what.startswith("Number out of range"):
        expected = "a number of usual size"
    elif what.startswith("Invalid enum value"):
        *others, last = (str(choice) for kind in _kinds(form) for choice in getattr(kind, "values", ()))
        expected = f"{', '.join(others)} or {last}" if others else last
    elif _limits(form) and not got:
        expected = _limits(form)
    return field, expected, value_found


def shortened(value: Any, most: int = 100) -> str:
    """A value as JSON, cut where it is long."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= most else text[:most] + "..."


def first_difference(name: str, a: Any, b: Any) -> tuple[str, Any, Any]:
    """Where two records differ first, as ``recipe_data.metal_rules.begin``, and both values (None: not recorded)."""
    if isinstance(a, dict) and isinstance(b, dict):
        key = next(key for key in {**a, **b} if a.get(key) != b.get(key))
        return first_difference(f"{name}.{key}", a.get(key), b.get(key))
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        place = next(place for place, (x, y) in enumerate(zip(a, b, strict=True)) if x != y)
        return first_difference(f"{name}.{place}", a[place], b[place])
    return name, a, b


_UNKNOWN = object()


def _at(value: Any, name: str, index: str) -> Any:
    """The value one step further; msgspec does not say at which key of a mapping a mistake is."""
    if name and isinstance(value, dict):
        return value.get(name, _UNKNOWN)
    if index.isdigit() and isinstance(value, list | tuple):
        return value[int(index)]
    return _UNKNOWN


def _form_at(form: Any, name: str, index: str) -> Any:
    """The type one step further, None where it is not known."""
    for option in _kinds(form):
        if name:
            for field in getattr(option, "fields", ()):
                if field.encode_name == name:
                    return field.type
        elif hasattr(option, "item_type"):
            return option.item_type
        elif hasattr(option, "item_types") and index.isdigit():
            return option.item_types[int(index)]
        elif hasattr(option, "value_type"):
            return option.value_type
    return None


def _kinds(form: Any) -> Any:
    """The types that a value may have, of one or of a union."""
    return getattr(form, "types", (form,))


def _limits(form: Any) -> str:
    """The range of a number as text; empty without a range."""
    for option in _kinds(form):
        least, above, most, below = (getattr(option, name, None) for name in ("ge", "gt", "le", "lt"))
        if least is not None and most is not None:
            return f"{least:.10g} to {most:.10g}"
        texts = (
            (least, "{:.10g} or more"), (above, "above {:.10g}"), (most, "up to {:.10g}"), (below, "below {:.10g}"),
        )  # fmt: skip
        if any(limit is not None for limit, _ in texts):
            return " and ".join(text.format(limit) for limit, text in texts if limit is not None)
    return ""


def _plain(text: str) -> str:
    """msgspec's names of types as text: `float | null` -> a number or null."""

    def words(match: re.Match[str]) -> str:
        return " or ".join(_WORDS.get(word, word) for word in match[1].split(" | "))

    return re.sub(r"`([^`]*)`", words, text)


def _require_finite(value: Any, where: object, remedy: str, path: str = "") -> None:
    """Refuse NaN and infinity, which Python's JSON reads although JSON has no such numbers.

    Raises:
        PolarguideError: there is one.
    """
    if isinstance(value, float) and not math.isfinite(value):
        place = f"{where} ({path.lstrip('.')})" if path else where
        raise PolarguideError(place, expected="a finite number", found=str(value), remedy=remedy)
    if isinstance(value, dict):
        for key, item in value.items():
            _require_finite(item, where, remedy, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            _require_finite(item, where, remedy, f"{path}[{number}]")
