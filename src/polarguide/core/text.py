"""Text from users and files: numbers, safe output on terminals, and safe CSV cells."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
import shlex
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import PurePath

_MOST_DIGITS = 10  # Python itself limits the number of digits


def canonical(name: str) -> str:
    """Return a name in the composed normal form of Unicode (NFC, UAX 15), in which names are compared.

    File systems and programs store the same name as different code points: ü is one, or u and a diaeresis.
    """
    return unicodedata.normalize("NFC", name)


def stem_of(path: PurePath) -> str:
    """Return a file's name without its suffix, in the form of ``canonical``."""
    return canonical(path.stem)


def decimal(text: str) -> float:
    """Parse a number like ``float``, but without underscores (``1_0`` is more often a typo of 1.0) and foreign digits.

    Raises:
        ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def whole_number(text: str) -> int | None:
    """Parse a whole number of at most nine ASCII digits; None for other texts."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < _MOST_DIGITS else None


def number_or_nan(text: str) -> float:
    """Parse a number like ``decimal``; NaN for other texts, so that every comparison with the number fails."""
    try:
        return decimal(text)
    except ValueError:
        return math.nan


def decimals(text: str) -> tuple[float, ...]:
    """Parse a comma-separated list of numbers such as 1.9,1,1.6; empty for other texts."""
    try:
        return tuple(decimal(part) for part in text.split(","))
    except ValueError:
        return ()


def listed(names: Sequence[str], limit: int = 4) -> str:
    """Return the first few names and the number of the others, for messages."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def command(*words: object) -> str:
    """Return a command line of polarguide with quoted names, ready for a shell.

    Args:
        words: the verb and its arguments; capital letters alone, such as SCENE, are placeholders.
    """
    return shlex.join(["polarguide", *map(str, words)])


_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")


def decimal_comma(cells: Iterable[str]) -> str:
    """Return the first text that is a number with a decimal comma, such as ``0,9238``, else an empty text."""
    return next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), "")


def printable(text: str, *, lines: bool = False) -> str:
    """Escape control characters in a text, such as names of files, before it is printed.

    Args:
        text: the text.
        lines: True: keep line breaks.
    """
    with contextlib.suppress(
        UnicodeEncodeError
    ):  # in the C locale, Python decodes names in UTF-8 to single bytes
        text = text.encode("utf-8", "surrogateescape").decode("utf-8", "surrogateescape")
    return "".join(
        sign
        if sign.isprintable() or (lines and sign == "\n")
        else sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        for sign in text
    )


_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of values as CSV.

    None is an empty cell, and an apostrophe precedes a text that looks like a formula.
    """
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows([csv_value(value) for value in row] for row in rows)
    return file.getvalue()


def csv_value(value: object) -> object:
    """Return a value without formulas for spreadsheets and control sequences for terminals."""
    if not isinstance(value, str):
        return value
    return printable(f"'{value}" if value.startswith(_FORMULA) else value, lines=True)
