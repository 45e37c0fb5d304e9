"""The tables of a comparison in Markdown, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from polarguide.evaluation.table import COLUMNS, PART_METRICS
from polarguide.experiments.aggregate import NO_VALUE, PartScores, cell_of
from polarguide.experiments.difference_tables import against_section, control_section
from polarguide.experiments.part_tables import material_section, object_section
from polarguide.experiments.results import Results
from polarguide.experiments.shown import MINUS, Label, Section, ShownCell
from polarguide.experiments.tables import scores_section
from polarguide.spreadsheet import csv_lines
from polarguide.text import printable

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
_DIFFERENCE_FIELDS = (
    "scene", "recipe", "other", "why", "metric", "mean", "low", "high", "over", "count", "seeds", "noise",
)  # fmt: skip


def sections(results: Results) -> list[Section]:
    """All tables of a comparison, in the order in which they are shown."""
    made = (
        scores_section(results),
        control_section(results),
        against_section(results),
        object_section(results),
        material_section(results),
    )
    return [section for section in made if section is not None]


def markdown(results: Results) -> str:
    """All tables in Markdown, each section with its notes."""
    lines = []
    for section in sections(results):
        level = "##"
        if section.title:
            lines += [f"## {_markdown_text(section.title)}", ""]
            level = "###"
        head = _markdown_row(map(_markdown_text, (*section.labels, *section.headings)))
        rule = "|" + "---|" * len(section.labels) + "---:|" * len(section.headings)
        for block in section.blocks:
            lines += [f"{level} {_markdown_text(block.title)}", "", head, rule]
            lines += [
                _markdown_row([*map(_markdown_label, row.labels), *map(_markdown_cell, row.cells)])
                for row in block.rows
            ]
            lines.append("")
        lines += [f"- {_markdown_text(note)}" for note in section.notes] + [""]
    return "\n".join(lines)


def _markdown_label(label: Label) -> str:
    text = f"`{printable(label.text)}`" if label.code else _markdown_text(label.text)
    return f"{text} ({_markdown_text(label.remark)})" if label.remark else text


def _markdown_cell(cell: ShownCell) -> str:
    value = f"**{cell.value}**" if cell.bold else cell.value
    return " ".join(filter(None, (value, _markdown_text(cell.more))))


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _markdown_text(text: str) -> str:
    """Text on one line that Markdown leaves alone."""
    special = "\\`*_[]<>#"
    return "".join("\\" + c if c in special else c for c in printable(" ".join(text.split())))


def latex(results: Results) -> str:
    """A ``tabular`` in the style of booktabs for each section, one block of rows after the other."""
    lines = ["% needs \\usepackage{booktabs}"]
    for section in sections(results):
        first, count = len(section.labels), len(section.labels) + len(section.headings)
        lines += [f"% {printable(section.title)}"] if section.title else []
        lines += [f"\\begin{{tabular}}{{{'l' * first}{'r' * (count - first)}}}", "\\toprule"]
        lines.append(_latex_row(map(latex_text, (*section.labels, *section.headings))))
        for block in section.blocks:
            title = f"\\multicolumn{{{count}}}{{l}}{{\\emph{{{latex_text(block.title)}}}}} \\\\"
            lines += ["\\midrule", title]
            lines += [
                _latex_row([*map(_latex_label, r.labels), *map(_latex_cell, r.cells)]) for r in block.rows
            ]
        lines += ["\\bottomrule", "\\end{tabular}"]
        lines += [f"% {printable(note)}" for note in section.notes]
    return "\n".join(" ".join(line.splitlines()) for line in lines) + "\n"


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + " \\\\"


def _latex_label(label: Label) -> str:
    return latex_text(f"{label.text} ({label.remark})" if label.remark else label.text)


def _latex_cell(cell: ShownCell) -> str:
    value = latex_text(cell.value)
    value = f"\\textbf{{{value}}}" if cell.bold else value
    return " ".join(filter(None, (value, latex_text(cell.more))))


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX reads as a command."""
    return "".join(_LATEX.get(character, character) for character in printable(" ".join(text.splitlines())))


def csv_text(results: Results) -> str:
    """The scores in full precision: ``scene`` (empty: mean over scenes), ``recipe``, ``runs``, key, key_spread, ..."""
    pairs = (name for column in COLUMNS for name in (column.key, f"{column.key}_spread"))
    rows = []
    for row in results["table"]:
        cells = [row["cells"].get(column.key, NO_VALUE) for column in COLUMNS]
        values = (value for cell in cells for value in (cell["mean"], cell["spread"]))
        rows.append([row["scene"] or "", row["recipe"], row["finished"], *values])
    return csv_lines([["scene", "recipe", "runs", *pairs], *rows])


def differences_csv(results: Results) -> str | None:
    """All paired differences in full precision (``scene`` empty: over scenes); None where there are none."""
    rows = [[d.get(field) for field in _DIFFERENCE_FIELDS] for d in results["differences"]]
    return csv_lines([_DIFFERENCE_FIELDS, *rows]) if rows else None


def parts_csv(results: Results) -> str | None:
    """Scores by object and material of every scene, means over seeds in full precision; None where there are none."""
    pairs = [name for column in PART_METRICS for name in (column.key, f"{column.key}_spread")]
    found: dict[tuple[str, str, str, str], list[PartScores]] = {}
    for scene, recipe, kind, name, scores in _parts(results):
        found.setdefault((scene, recipe, kind, name), []).append(scores)
    rows = []
    for place, seeds in found.items():
        cells = [cell_of([scores["metrics"].get(column.key) for scores in seeds]) for column in PART_METRICS]
        values = (value for cell in cells for value in (cell["mean"], cell["spread"]))
        rows.append(
            [*place, seeds[0]["material"], seeds[0]["pixels"], seeds[0]["views"], len(seeds), *values]
        )
    head = ["scene", "recipe", "part", "name", "material", "pixels", "views", "runs", *pairs]
    return csv_lines([head, *rows]) if rows else None


def _parts(results: Results) -> Iterator[tuple[str, str, str, str, PartScores]]:
    for run in results["runs"]:
        for name, scores in run["objects"].items():
            yield run["scene"], run["recipe"], "object", name, scores
        for name, scores in run["materials"].items():
            yield run["scene"], run["recipe"], "material", name, scores
