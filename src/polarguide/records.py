"""Records that are read back from JSON files: validated, with the file and the value found in every message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from polarguide.errors import PolarguideError

T = TypeVar("T")


def parse_json(path: Path, data: bytes) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        PolarguideError: it is not JSON, or not an object.
    """
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise PolarguideError(
            path, expected="a JSON file", found=f"broken JSON ({error})", remedy="Correct or remove the file."
        ) from error
    if not isinstance(content, dict):
        raise PolarguideError(
            path,
            expected="a JSON object {...}",
            found=f"a JSON {type(content).__name__}",
            remedy="Correct or remove the file.",
        )
    return content


def decode(data: bytes, kind: type[T], where: object, *, remedy: str = "Correct or remove the file.") -> T:
    """A record from JSON, with fields of the right types.

    Args:
        data: the JSON text. kind: a dataclass or another type that msgspec knows.
        where: what an error message calls it. remedy: its advice.

    Raises:
        PolarguideError: it is not JSON, or not such a record.
    """
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PolarguideError(
            where, expected=f"a record of the kind {kind.__name__}", found=f"that {error}", remedy=remedy
        ) from None


def read_record(path: Path, kind: type[T], *, remedy: str = "Correct or remove the file.") -> T:
    """A record from a JSON file; see ``decode``.

    Raises:
        PolarguideError: the file cannot be read, or holds something else.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PolarguideError(
            path, expected="a readable file", found=error.strerror or str(error), remedy=remedy
        ) from None
    return decode(data, kind, path, remedy=remedy)
