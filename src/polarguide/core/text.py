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
    """Return a name in the composed normal form of Unicode (NFC, UAX 15), so that equal names compare equal.

    File systems and programs may store one name as different code points. For example, ü is one code point, or u and a
    diaeresis.
    """
    return unicodedata.normalize("NFC", name)


def stem_of(path: PurePath) -> str:
    """Return a file's name without its suffix, in the form of ``canonical``."""
    return canonical(path.stem)


def decimal(text: str) -> float:
    """Parse a number like ``float``, but accept only ASCII digits and no underscores.

    A text such as ``1_0`` is probably a typing error for 1.0.

    Raises:
        ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def whole_number(text: str) -> int | None:
    """Parse a whole number of at most nine ASCII digits; return None for other texts."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < _MOST_DIGITS else None


def number_or_nan(text: str) -> float:
    """Parse a number like ``decimal``; return NaN for other texts, so that every comparison fails."""
    try:
        return decimal(text)
    except ValueError:
        return math.nan


def decimals(text: str) -> tuple[float, ...]:
    """Parse a comma-separated list of numbers such as 1.9,1,1.6; return an empty tuple for other texts."""
    try:
        return tuple(decimal(part) for part in text.split(","))
    except ValueError:
        return ()


def listed(names: Sequence[str], limit: int = 4) -> str:
    """Return the first ``limit`` names as text, and the number of further names, for messages."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def command(*words: object) -> str:
    """Return a command line of polarguide with quoted names, ready for a shell.

    Args:
        words: the verb and its arguments. A word in capital letters, such as SCENE, is a placeholder and is not quoted.
    """
    return shlex.join(["polarguide", *map(str, words)])


_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")


def decimal_comma(cells: Iterable[str]) -> str:
    """Return the first cell that is a number with a decimal comma, such as ``0,9238``, or an empty text."""
    return next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), "")


def printable(text: str, *, lines: bool = False) -> str:
    """Escape control characters in a text, such as a file name, so that it is safe to print.

    Args:
        text: the text.
        lines: keep line breaks.
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

    None becomes an empty cell. A text that looks like a formula gets an apostrophe in front.
    """
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows([csv_value(value) for value in row] for row in rows)
    return file.getvalue()


def csv_value(value: object) -> object:
    """Make a value safe for spreadsheets and terminals: disable formulas and escape control characters."""
    if not isinstance(value, str):
        return value
    return printable(f"'{value}" if value.startswith(_FORMULA) else value, lines=True)
