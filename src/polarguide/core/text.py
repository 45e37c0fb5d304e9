"""Texts from people and from files: numbers in them, what a terminal would obey, and CSV cells that are no formulas."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
import shlex
import unicodedata
from collections.abc import Iterable
from pathlib import PurePath

_MOST_DIGITS = 10  # Python itself refuses thousands of them


def canonical(name: str) -> str:
    """A name in the composed form of Unicode (NFC, UAX 15), in which names are compared.

    File systems and programs store one name as different characters: an u-umlaut is one sign, or u and two dots.
    """
    return unicodedata.normalize("NFC", name)


def stem_of(path: PurePath) -> str:
    """A file's name without its suffix, ``canonical``."""
    return canonical(path.stem)


def decimal(text: str) -> float:
    """A number as ``float`` reads it, without underscores (``1_0`` is more often a slip for 1.0 than ten) and digits of
    other scripts.

    Raises:
        ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def whole_number(text: str) -> int | None:
    """A whole number of plain digits; None for other texts, and for more digits than any count here has."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < _MOST_DIGITS else None


def number_or_nan(text: str) -> float:
    """A number as ``decimal`` reads it; NaN if it is malformed, which every comparison refuses."""
    try:
        return decimal(text)
    except ValueError:
        return math.nan


def decimals(text: str) -> tuple[float, ...]:
    """The numbers of a list such as 1.9,1,1.6; none if it is something else."""
    try:
        return tuple(decimal(part) for part in text.split(","))
    except ValueError:
        return ()


def command(*words: object) -> str:
    """A command line of polarguide that a shell takes as it is printed, whatever blanks names have.

    Args:
        words: the verb and what follows it; capital letters alone, such as SCENE, are for people to replace.
    """
    return shlex.join(["polarguide", *map(str, words)])


_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")


def decimal_comma(cells: Iterable[str]) -> str:
    """The first of several texts that is a number with a decimal comma, as ``0,9238``; empty where none is."""
    return next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), "")


def printable(text: str, *, lines: bool = False) -> str:
    """Escape control characters in a text, such as names of files, before it is printed.

    Args:
        lines: whether it may have several lines.
    """
    with contextlib.suppress(
        UnicodeEncodeError
    ):  # in the C locale, Python has made names in UTF-8 single bytes
        text = text.encode("utf-8", "surrogateescape").decode("utf-8", "surrogateescape")
    return "".join(
        sign
        if sign.isprintable() or (lines and sign == "\n")
        else sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        for sign in text
    )


_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Rows of values as CSV; None is an empty cell, and texts that begin as formulas get an apostrophe in front."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows([csv_value(value) for value in row] for row in rows)
    return file.getvalue()


def csv_value(value: object) -> object:
    """A value that spreadsheets do not take for a formula, nor terminals for a command: names come from files."""
    if not isinstance(value, str):
        return value
    return printable(f"'{value}" if value.startswith(_FORMULA) else value, lines=True)
