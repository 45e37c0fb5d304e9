"""Texts from people and from files: numbers in them, what a terminal would obey, and CSV cells that are no formulas."""

from __future__ import annotations

import csv
import io
import math
import shlex
from collections.abc import Iterable


def decimal(text: str) -> float:
    """A number as ``float`` reads it, without underscores (``1_0`` is more often a slip for 1.0 than ten) and digits of
    other scripts.

    Raises:
        ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


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


def printable(text: str, *, lines: bool = False) -> str:
    """Escape control characters in a text, such as names of files, before it is printed.

    Args:
        lines: whether it may have several lines.
    """
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
    csv.writer(file, lineterminator="\n").writerows([plain(value) for value in row] for row in rows)
    return file.getvalue()


def plain(value: object) -> object:
    """A value that spreadsheets do not take for a formula, nor terminals for a command: names come from files."""
    if not isinstance(value, str):
        return value
    return printable(f"'{value}" if value.startswith(_FORMULA) else value, lines=True)
