"""CSV text whose cells no spreadsheet takes for formulas."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Rows of values as CSV; None is an empty cell, and texts that begin as formulas get an apostrophe in front."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows([plain(value) for value in row] for row in rows)
    return file.getvalue()


def plain(value: object) -> object:
    """A value that spreadsheets do not take for a formula: names come from files and folders."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
