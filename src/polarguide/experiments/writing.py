"""The files of a comparison but its report: record, tables to read, and CSV."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from polarguide.core.files import write_text
from polarguide.core.text import plain, printable
from polarguide.experiments.results import Results
from polarguide.experiments.tables import MINUS, Section, sections
from polarguide.visualization.pages import templates

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "±": r"$\pm$",
    "≈": r"$\approx$",
    MINUS: "$-$",
    **{character: "\\" + character for character in "&%$#_{}"},
}
_MARKDOWN = {character: "\\" + character for character in "\\`*_[]<>#"}
_TEXTS = templates("polarguide.experiments").overlay(
    # Braces are LaTeX's.
    variable_start_string="<<", variable_end_string=">>", block_start_string="<%", block_end_string="%>",
)  # fmt: skip


def markdown_text(text: str) -> str:
    """Text on one line that Markdown leaves alone."""
    return "".join(_MARKDOWN.get(character, character) for character in printable(" ".join(text.split())))


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX reads as a command."""
    return "".join(_LATEX.get(character, character) for character in printable(" ".join(text.splitlines())))


_TEXTS.filters.update(md=markdown_text, tex=latex_text, printable=printable)


def write_tables(out: Path, results: Results) -> None:
    """Write ``results.json``, ``.md``, ``.csv`` and ``.tex``, each in one step, and what else there is as CSV."""
    write_text(out / "results.json", json.dumps(results.content(), indent=1, allow_nan=False) + "\n")
    tables = sections(results)
    for name in ("results.md", "results.tex"):
        write_text(out / name, readable(tables, name))
    for name, frame in (
        ("results.csv", results.scores),
        ("differences.csv", results.differences),
        ("parts.csv", results.parts),
    ):
        if frame.empty:
            (out / name).unlink(missing_ok=True)  # of a comparison with other recipes
        else:
            write_text(out / name, csv_text(frame))


def readable(tables: Sequence[Section], name: str) -> str:
    """Tables with their notes, as ``results.md`` or ``results.tex``."""
    return _TEXTS.get_template(name).render(sections=tables)


def csv_text(frame: pd.DataFrame) -> str:
    """A frame in full precision; nothing in it is a formula to a spreadsheet."""
    return frame.map(plain).to_csv(index=False, lineterminator="\n")
