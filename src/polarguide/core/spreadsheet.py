"""CSV text whose cells no spreadsheet takes for formulas, and no terminal for commands."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable

from polarguide.core.text import printable

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
