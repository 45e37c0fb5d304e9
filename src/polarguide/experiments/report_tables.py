"""The tables of a comparison as HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence

from polarguide.experiments.shown import Block, Label, Section, ShownCell

SCORES = "Scores on held-out views"


def section_html(section: Section) -> str:
    """The tables of a section and its notes."""
    names = (*section.labels, *section.headings)
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    tables = "".join(_table(block, head, len(section.labels)) for block in section.blocks)
    return (
        f'<section id="{section.key}"><h2>{html.escape(section.title or SCORES)}</h2>{tables}'
        f'<div class="notes">{list_html(section.notes)}</div></section>'
    )


def _table(block: Block, head: str, labels: int) -> str:
    rows = "".join(
        f"<tr>{''.join(map(_label, row.labels))}{''.join(map(_cell, row.cells))}</tr>" for row in block.rows
    )
    return (
        f'<h3>{html.escape(block.title)}</h3><div class="scroll"><table class="labels{labels}"><thead><tr>{head}</tr>'
        f"</thead><tbody>{rows}</tbody></table></div>"
    )


def _label(label: Label) -> str:
    remark = f" <small>({html.escape(label.remark)})</small>" if label.remark else ""
    return f"<th>{html.escape(label.text)}{remark}</th>"


def _cell(cell: ShownCell) -> str:
    value, more = html.escape(cell.value), html.escape(cell.more)
    value = f"<b>{value}</b>" if cell.bold else value
    return f"<td>{value}{f' <small>{more}</small>' if more else ''}</td>"


def list_html(texts: Sequence[str]) -> str:
    """A list of sentences; empty without any."""
    return "<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in texts) + "</ul>" if texts else ""
