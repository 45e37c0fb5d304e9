"""The table of a comparison as Markdown, CSV and LaTeX, and as cells for the report."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from polarguide.evaluation.table import COLUMNS, Metric
from polarguide.experiments.aggregate import NO_VALUE, Cell, Row
from polarguide.experiments.results import Results

MEAN_TITLE = "mean over scenes"
NOT_APPLICABLE = "n/a"
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "±": r"$\pm$",
    **{character: "\\" + character for character in "&%$#_{}"},
}


@dataclass(frozen=True)
class ShownCell:
    """A cell as people read it: a value, its spread (empty: none), and whether it is the best of its column."""

    value: str
    spread: str = ""
    best: bool = False


@dataclass(frozen=True)
class Block:
    """The rows of one scene: its title, and for every recipe the shown cells."""

    title: str
    rows: tuple[tuple[str, tuple[ShownCell, ...]], ...]


def shown_columns(results: Results) -> tuple[Metric, ...]:
    """The columns that people see: those with a value in some row."""
    return tuple(
        column
        for column in COLUMNS
        if column.shown == "tables" and any(_cell_of(row, column)["count"] for row in results["table"])
    )


def blocks(results: Results) -> list[Block]:
    """The table by scenes, formatted, with the best of every column marked."""
    columns = shown_columns(results)
    titles: dict[str | None, str] = {row["scene"]: row["scene"] or MEAN_TITLE for row in results["table"]}
    made = []
    for scene, title in titles.items():
        rows = [row for row in results["table"] if row["scene"] == scene]
        best = [best_rows(rows, column) for column in columns]
        cells = [
            tuple(
                _cell(row, column, index in winners, results["table"])
                for column, winners in zip(columns, best, strict=True)
            )
            for index, row in enumerate(rows)
        ]
        made.append(Block(title, tuple((r["recipe"], c) for r, c in zip(rows, cells, strict=True))))
    return made


def best_rows(rows: Sequence[Row], column: Metric) -> set[int]:
    """Which rows are best in a column, as far as its shown digits tell; none where fewer than two have a value."""
    values = {i: _shown_number(_cell_of(row, column), column) for i, row in enumerate(rows)}
    numbers = {index: value for index, value in values.items() if value is not None}
    if column.better is None or len(numbers) < 2:
        return set()
    best = max(numbers.values()) if column.better == "higher" else min(numbers.values())
    return {index for index, value in numbers.items() if value == best}


def notes(results: Results) -> list[str]:
    """What a reader of the table has to know, a sentence each."""
    said = ["↑ higher is better, ↓ lower is better; the best of each scene and column is bold."]
    seeds = results["settings"]["seeds"]
    if seeds > 1:
        said.append(f"Mean ± sample standard deviation over {seeds} seeds.")
    else:
        said.append("One seed: differences may be within what a seed moves.")
    if len(results["scenes"]) > 1:
        said.append(
            "Mean over scenes: over those where any recipe has a value of the column, with one weight each."
        )
    reasons = {r["lpips_reason"]: 0 for r in results["runs"] if r["state"] == "done" and r["lpips_reason"]}
    said += [f"LPIPS {NOT_APPLICABLE}: {reason}." for reason in reasons]
    unfinished = [r for r in results["runs"] if r["state"] != "done"]
    for run in unfinished:
        what = "failed" if run["state"] == "failed" else "has not finished"
        error = f": {run['error']}" if run["error"] else ""
        said.append(f"{run['scene']}, {run['recipe']}, seed {run['seed']} {what}{error}")
    return said


def markdown(results: Results) -> str:
    """The table in Markdown, a heading for every scene, then the notes."""
    columns = shown_columns(results)
    lines = []
    for block in blocks(results):
        lines += [f"## {_markdown_text(block.title)}", ""]
        lines.append(_markdown_row(["recipe", *(column.heading for column in columns)]))
        lines.append("|---|" + "---:|" * len(columns))
        for recipe, cells in block.rows:
            lines.append(_markdown_row([f"`{recipe}`", *(_marked(cell, "**", "**") for cell in cells)]))
        lines.append("")
    lines += [f"- {_markdown_text(note)}" for note in notes(results)]
    return "\n".join(lines) + "\n"


def csv_text(results: Results) -> str:
    """All columns in full precision: ``scene`` (empty: mean over scenes), ``recipe``, ``runs``, key, key_spread, ..."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    pairs = (name for column in COLUMNS for name in (column.key, f"{column.key}_spread"))
    writer.writerow(["scene", "recipe", "runs", *pairs])
    for row in results["table"]:
        cells = [_cell_of(row, column) for column in COLUMNS]
        values = (value for cell in cells for value in (cell["mean"], cell["spread"]))
        writer.writerow([row["scene"] or "", row["recipe"], row["finished"], *values])
    return file.getvalue()


def latex(results: Results) -> str:
    """A ``tabular`` in the style of booktabs, one block of rows for every scene."""
    columns = shown_columns(results)
    lines = ["% needs \\usepackage{booktabs}", f"\\begin{{tabular}}{{l{'r' * len(columns)}}}", "\\toprule"]
    lines.append(_latex_row(["recipe", *(column.heading for column in columns)]))
    for block in blocks(results):
        lines.append("\\midrule")
        lines.append(f"\\multicolumn{{{len(columns) + 1}}}{{l}}{{\\emph{{{latex_text(block.title)}}}}} \\\\")
        for recipe, cells in block.rows:
            shown = [_marked(c, "\0", "\1") for c in cells]
            lines.append(_latex_row([recipe, *shown]).replace("\0", "\\textbf{").replace("\1", "}"))
    lines += ["\\bottomrule", "\\end{tabular}"]
    lines += [f"% {note}" for note in notes(results)]
    return "\n".join(" ".join(line.splitlines()) for line in lines) + "\n"


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX reads as a command."""
    return "".join(_LATEX.get(character, character) for character in text)


def _cell_of(row: Row, column: Metric) -> Cell:
    """A record of an older version lacks the metrics that came later."""
    return row["cells"].get(column.key, NO_VALUE)


def _cell(row: Row, column: Metric, best: bool, table: Sequence[Row]) -> ShownCell:
    cell = _cell_of(row, column)
    if cell["mean"] is None:
        # A speed that was not measured alone, or a run that has not finished, is not "not applicable".
        known = row["scene"] is None and any(
            other["recipe"] == row["recipe"] and _cell_of(other, column)["count"] for other in table
        )
        return ShownCell("" if column.timed or not row["finished"] or known else NOT_APPLICABLE)
    spread = "" if cell["spread"] is None else formatted(cell["spread"], column)
    return ShownCell(formatted(cell["mean"], column), spread, best)


def _shown_number(cell: Cell, column: Metric) -> float | None:
    return None if cell["mean"] is None else round(cell["mean"] * column.factor, column.digits)


def formatted(value: float, column: Metric) -> str:
    """A recorded value as tables show it, without its unit."""
    return f"{value * column.factor:,.{column.digits}f}"


def _marked(cell: ShownCell, before: str, after: str) -> str:
    value = f"{before}{cell.value}{after}" if cell.best else cell.value
    return f"{value} ± {cell.spread}" if cell.spread else value


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _markdown_text(text: str) -> str:
    """Text on one line that Markdown leaves alone."""
    special = "\\`*_[]<>#"
    return "".join("\\" + c if c in special else c for c in " ".join(text.split()))


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(latex_text(cell) for cell in cells) + " \\\\"
