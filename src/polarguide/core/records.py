"""Reading and validation of JSON records with msgspec.

Every error message names the file, the field, and the invalid value.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file

T = TypeVar("T")
CORRECT = "Correct or remove the file."
_OBJECT = "a JSON object {...}"
_NAMES = {
    "BoolType": "true or false", "FloatType": "a number", "IntType": "a whole number", "NoneType": "null",
    "StrType": "text", "ListType": "a list", "TupleType": "a list", "VarTupleType": "a list",
}  # fmt: skip
"""Name of each class of ``msgspec.inspect`` in messages. All other classes are called JSON objects."""
_LARGEST_INTEGER = 1 << 63
_DEEPEST = 50
LARGEST_RECORD = 1 << 26
"""Largest accepted size of a JSON file in bytes. Decoded data needs about twenty times as much memory."""


def read_record(path: Path, kind: type[T], *, remedy: str = CORRECT) -> T:
    """Read a record from a JSON file.

    Args:
        path: the file.
        kind: a type that msgspec supports: a ``Struct``, a dataclass, ``dict[str, Any]``, ...
        remedy: advice for the message about an invalid file.

    Raises:
        PolarguideError: the file cannot be read, or ``decode`` rejects it.
    """
    return decode(read_file(path, largest=LARGEST_RECORD, remedy=remedy), kind, path, remedy=remedy)


def decode(data: bytes | Any, kind: type[T], where: object, *, remedy: str = CORRECT) -> T:
    """Convert JSON to a validated record.

    Numbers must be finite, Booleans are not numbers, and keys must be unique. Unknown keys are ignored unless the type
    forbids them.

    Args:
        data: JSON text as bytes, or parsed JSON.
        kind: a type that msgspec supports.
        where: file or option that error messages name.
        remedy: advice for the message about invalid data.

    Raises:
        PolarguideError: the data is not JSON, or does not fit the type.
    """
    value = parse(data, where, remedy=remedy) if isinstance(data, bytes) else data
    try:
        _require_shallow(value)
        record = msgspec.convert(value, kind)
    except PolarguideError as error:  # raised by a check of the type itself
        place = f"{where} ({error.where})"
        raise PolarguideError(place, expected=error.expected, found=error.found, remedy=remedy) from None
    except msgspec.ValidationError:
        path, expected, found = _fault(value, kind)
        at_fault = f"{where} ({path})" if path else where
        raise PolarguideError(at_fault, expected=expected, found=found, remedy=remedy) from None
    except (ValueError, RecursionError, OverflowError) as error:
        raise PolarguideError(
            where, expected="a JSON file", found=f"broken JSON ({error})", remedy=remedy
        ) from None
    _require_finite(msgspec.to_builtins(record, enc_hook=str), where, remedy)
    return record


def parse(data: bytes, where: object, *, remedy: str = CORRECT) -> Any:
    """Parse JSON text to values of any type.

    NaN and infinity are accepted: ``decode`` checks them in the fields of a type.

    Raises:
        PolarguideError: the data is not JSON, or a key occurs twice.
    """
    try:
        value = json.loads(data, object_pairs_hook=_each_once)
        _require_shallow(value)
    except (ValueError, RecursionError) as error:
        raise PolarguideError(
            where, expected="a JSON file", found=f"broken JSON ({error})", remedy=remedy
        ) from None
    return value


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object with unique keys, because the JSON standard does not define the meaning of a repeated key.

    Raises:
        ValueError: a key occurs twice.
    """
    record = dict(pairs)
    if len(record) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{shortened(next(key for key in record if keys.count(key) > 1))} occurs twice")
    return record


def _require_shallow(value: Any) -> None:
    """Raise an error for deeply nested data, which later code could not process recursively.

    Raises:
        RecursionError: the data is nested more deeply than any record of this project.
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
    """Return the command-line option that sets a field."""
    return "--" + field.replace("_", "-")


def check_options(options: Any, name: Callable[[str], str] = option_name) -> None:
    """Validate the values of a dataclass against its annotations.

    Args:
        options: the dataclass.
        name: returns the name of a field for messages.

    Raises:
        PolarguideError: a value has the wrong type or is out of range.
    """
    remedy = "Correct the value."
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    for field, value in values.items():
        _require_finite(value, name(field), remedy)
    try:
        _convert(values, type(options))
    except msgspec.ValidationError:
        path, expected, found = _fault(values, type(options))
        field = path.partition("[")[0]
        raise PolarguideError(name(field), expected=expected, found=found, remedy=remedy) from None


def to_json(content: Any) -> bytes:
    """Return a record as the bytes of a JSON file. File names that are not valid Unicode are escaped."""
    try:
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()
    except UnicodeEncodeError:
        return (json.dumps(content, indent=1) + "\n").encode()


def _convert(value: Any, kind: Any) -> Any:
    return msgspec.convert(value, kind, dec_hook=lambda custom, part: custom(part))


def _fault(value: Any, kind: Any, path: str = "") -> tuple[str, str, str]:
    """Find the part of a value that does not fit a type.

    Returns:
        The path of the part in the value, the expected type, and the part itself, as texts for a message.
    """
    for step, part, part_kind in _parts(value, kind):
        try:
            _convert(part, part_kind)
        except msgspec.ValidationError:
            return _fault(part, part_kind, path + step)
    form = msgspec.inspect.type_info(kind)
    options = getattr(form, "types", (form,))
    expected, found = _mismatched_fields(value, options) or (_described(value, options), shortened(value))
    return path.lstrip("."), expected, found


def _parts(value: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the direct parts of a value. Each has its path relative to the value, the part, and its expected type."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin in (Annotated, Union, UnionType):
        for option in arguments[:1] if origin is Annotated else arguments:
            yield from _parts(value, option)
    elif origin in (list, tuple) and isinstance(value, list | tuple):
        kinds = [arguments[0]] * len(value) if origin is list or arguments[-1] is ... else arguments
        for number, (item, item_kind) in enumerate(zip(value, kinds, strict=False)):
            yield f"[{number}]", item, item_kind
    elif origin is dict and isinstance(value, dict):
        yield from ((f".{key}", item, arguments[1]) for key, item in value.items())
    elif isinstance(value, dict):
        fields = getattr(msgspec.inspect.type_info(kind), "fields", ())
        hints = _field_types(kind) if fields else {}
        for field in fields:
            if field.encode_name in value:
                yield f".{field.encode_name}", value[field.encode_name], hints[field.name]


def _field_types(kind: Any) -> dict[str, Any]:
    """Return the type of each field of a record by name. Parameters of a generic type are replaced by actual types."""
    origin = get_origin(kind) or kind
    arguments = dict(zip(getattr(origin, "__parameters__", ()), get_args(kind), strict=False))
    types = get_type_hints(origin, include_extras=True)
    for name, hint in types.items():
        parameters = getattr(hint, "__parameters__", ())
        if parameters:
            types[name] = hint[tuple(arguments.get(parameter, Any) for parameter in parameters)]
    return types


def _mismatched_fields(value: Any, options: Any) -> tuple[str, str] | None:
    """Return the expected and the actual field names of a JSON object, or None if its field names are valid."""
    for option in options:
        fields = {field.encode_name: field.required for field in getattr(option, "fields", ())}
        if fields and isinstance(value, dict):
            missing = [name for name, required in fields.items() if required and name not in value]
            closed = getattr(option, "forbid_unknown_fields", False)
            known = {*fields, getattr(option, "tag_field", None)}
            unknown = [name for name in value if closed and name not in known]
            if missing:
                return f"the field {missing[0]}", f"only {', '.join(value)}" if value else "none"
            if unknown:
                return f"only {', '.join(fields)}", unknown[0]
    return None


def _described(value: Any, options: Any) -> str:
    """Describe the expected types of a value, or its limits if the type of the value is valid."""
    names = []
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
        return "a number of usual size"
    for option in options:
        if number and _limits(option):
            return _limits(option)
        name = _NAMES.get(type(option).__name__, _OBJECT)
        if hasattr(option, "values"):
            name = ", ".join(map(str, option.values))
            name = " or ".join(name.rsplit(", ", 1))
        elif hasattr(option, "item_types"):
            name += f" of length {len(option.item_types)}"
        for limit, sign in (("min_length", ">="), ("max_length", "<=")):
            if getattr(option, limit, None) is not None:
                name += f" of length {sign} {getattr(option, limit)}"
        names.append(name)
    return " or ".join(names)


def shortened(value: Any, most: int = 100) -> str:
    """Return a value as JSON, truncated to ``most`` characters."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= most else text[:most] + "..."


def first_differing_value(name: str, a: Any, b: Any) -> tuple[str, Any, Any]:
    """Return the name of the first field in which two records differ, and both values.

    None represents a value that is not recorded. The name of a nested field is a path, such as
    ``recipe_data.metal_rules.begin``.
    """
    if isinstance(a, dict) and isinstance(b, dict):
        key = next(key for key in {**a, **b} if key not in a or key not in b or a[key] != b[key])
        return first_differing_value(f"{name}.{key}", a.get(key), b.get(key))
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        place = next(place for place, (x, y) in enumerate(zip(a, b, strict=True)) if x != y)
        return first_differing_value(f"{name}.{place}", a[place], b[place])
    return name, a, b


def _limits(option: Any) -> str:
    """Return the valid range of a number as text, or an empty text if there is no range."""
    least, above, most, below = (getattr(option, name, None) for name in ("ge", "gt", "le", "lt"))
    if least is not None and most is not None:
        return f"{least:.10g} to {most:.10g}"
    texts = (
        (least, "{:.10g} or more"), (above, "above {:.10g}"), (most, "up to {:.10g}"), (below, "below {:.10g}"),
    )  # fmt: skip
    return " and ".join(text.format(limit) for limit, text in texts if limit is not None)


def _require_finite(value: Any, where: object, remedy: str, path: str = "") -> None:
    """Raise an error for NaN and infinity, which Python's JSON parser accepts although JSON does not define them.

    Raises:
        PolarguideError: a number is not finite.
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
