"""Tables of the documentation and of printed records."""

from collections.abc import Iterable
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"


def row_lists(lines: Iterable[str]) -> list[list[list[str]]]:
    """Tables of a Markdown text: the cells of each row, the heading first."""
    tables = []
    within = False
    for line in lines:
        if line[:1] != "|":
            within = False
            continue
        if not within:
            tables.append([])
            within = True
        if not line.startswith("|---"):
            tables[-1].append([cell.strip() for cell in line.split("|")[1:-1]])
    return tables


def tables_of(lines: Iterable[str]) -> list[list[dict[str, str]]]:
    """Tables of a Markdown text: a list of rows each, with cells by heading."""
    tables = row_lists(lines)
    return [[dict(zip(heading, row, strict=True)) for row in rows] for heading, *rows in tables]


def page_rows(page: str, *headings: str) -> list[list[str]]:
    """The rows, heading included, of the table of a page whose first headings are these."""
    lines = (DOCS / f"{page}.md").read_text(encoding="utf-8").splitlines()
    (table,) = [table for table in row_lists(lines) if tuple(table[0])[: len(headings)] == headings]
    return table


def page_table(page: str, *headings: str) -> list[dict[str, str]]:
    """The rows of such a table by heading."""
    heading, *rows = page_rows(page, *headings)
    return [dict(zip(heading, row, strict=True)) for row in rows]
