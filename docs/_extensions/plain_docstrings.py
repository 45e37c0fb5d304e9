"""Conversion of docstrings, which are plain text with ``code``, to reStructuredText."""

from __future__ import annotations

import inspect
import re
import sys
from typing import Any, TypeVar

from sphinx.application import Sphinx

_LITERAL = re.compile(r"(``.+?``)")
_MARKUP = re.compile(r"([\\*|`])|(?<=\w)_(?!\w)")


def escaped(line: str) -> str:
    """Escape markup outside of ``literals`` in a line."""
    parts = _LITERAL.split(line)
    parts[::2] = [_MARKUP.sub(lambda found: "\\" + found.group(), part) for part in parts[::2]]
    return "".join(parts)


def indentation(line: str) -> int:
    """Return the indentation of a line."""
    return len(line) - len(line.lstrip())


def names_of(found: Any) -> set[str]:
    """Return the names that a docstring may list: parameters of a function, or fields of a class."""
    try:
        parameters = set(inspect.signature(found).parameters)
    except (TypeError, ValueError):
        parameters = set()
    return parameters | set(getattr(found, "__annotations__", {}))


def one_each(lines: list[str], names: set[str]) -> list[str]:
    """Put entries that share a line, such as ``width: pixels. height: pixels.``, on lines of their own."""
    if not names:
        return lines
    name = "(?:" + "|".join(map(re.escape, sorted(names))) + ")"
    boundary = re.compile(rf"(?<=[.;,]) (?={name}(?:, {name})*: )")
    result: list[str] = []
    entry = ""  # indentation of the entries of the section that is being read
    for number, line in enumerate(lines):
        if line.strip() in ("Args:", "Attributes:") and number + 1 < len(lines):
            entry = " " * indentation(lines[number + 1])
        elif line.strip() and indentation(line) < len(entry):
            entry = ""
        first, *others = boundary.split(line) if entry else [line]
        result += [first, *(entry + other for other in others)]
    return result


def plain(lines: list[str]) -> list[str]:
    """Convert a text to reStructuredText. Literals may span lines, and indented blocks stay unchanged."""
    text = "\n".join(lines)
    # A literal that is broken over two lines is one literal.
    text = re.sub(r"``[^`]+``", lambda found: re.sub(r"\s*\n\s*", " ", found.group()), text)
    result: list[str] = []
    block: int | None = None  # indentation of the text above the block that is being copied
    before = ""  # the last line with text
    for line in text.split("\n"):
        if block is not None and line.strip() and indentation(line) <= block:
            block = None
        starts = result and not result[-1].strip() and indentation(line) > indentation(before)
        if block is None and line.strip() and starts and not before.rstrip().endswith("::"):
            block = indentation(before)
            result += [" " * block + "::", ""]
        keep = block is not None or line.lstrip().startswith((">>>", "..."))
        result.append(line if keep else escaped(line))
        before = line if line.strip() else before
    return result


def process(app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    lines[:] = one_each(plain(lines), names_of(found))


def skip(app: Sphinx, what: str, name: str, found: Any, skipped: bool, options: Any) -> bool | None:
    """Remove the generic text of fields of named tuples, because the class describes them."""
    return True if (getattr(found, "__doc__", None) or "").startswith("Alias for field number") else None


def leave_type_variables(app: Sphinx, environment: Any, node: Any, text: Any) -> Any:
    """Show a type variable without a link, because it has no page."""
    module, _, name = node.get("reftarget", "").rpartition(".")
    return text if isinstance(getattr(sys.modules.get(module), name, None), TypeVar) else None


def setup(app: Sphinx) -> dict[str, bool]:
    # Before napoleon, which turns the sections of a docstring into reStructuredText.
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-skip-member", skip)
    app.connect("missing-reference", leave_type_variables)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
