"""Tables as people read them, before they become Markdown, LaTeX or HTML: sections of blocks of rows of cells."""

from __future__ import annotations

from dataclasses import dataclass

from polarguide.evaluation.table import Metric

NOT_APPLICABLE = "n/a"
MEAN_TITLE = "mean over scenes"
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class ShownCell:
    """A cell: a value, what stands after it (spread, interval; empty: nothing), and whether it is bold."""

    value: str = ""
    more: str = ""
    bold: bool = False


@dataclass(frozen=True)
class Label:
    """What a row is called: a name, whether it is one of code (a recipe), and a remark after it (empty: none)."""

    text: str
    code: bool = False
    remark: str = ""


@dataclass(frozen=True)
class Row:
    """A row: as many labels as its section has, and as many cells as that has headings."""

    labels: tuple[Label, ...]
    cells: tuple[ShownCell, ...]


@dataclass(frozen=True)
class Block:
    """Rows under a title."""

    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Section:
    """Blocks with the same columns.

    Attributes:
        key: name for links. title: heading; empty for the scores, which come first.
        labels: headings of the labels. headings: those of the cells. blocks: the rows.
        notes: what a reader has to know, a sentence each.
    """

    key: str
    title: str
    labels: tuple[str, ...]
    headings: tuple[str, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...] = ()


def formatted(value: float, column: Metric) -> str:
    """A recorded value as tables show it, without its unit."""
    return f"{value * column.factor:,.{column.digits}f}"


def signed(value: float, column: Metric) -> str:
    """A difference of recorded values as tables show it, with a true minus sign and never a negative zero."""
    text = f"{round(value * column.factor, column.digits) + 0.0:+,.{column.digits}f}"
    return text.replace("-", MINUS)
