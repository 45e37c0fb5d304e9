"""Docstrings of this project are plain text with ``code``, not reStructuredText: what would be markup is escaped."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

_LITERAL = re.compile(r"(``.+?``)")
_MARKUP = re.compile(r"([\\*|`])|(?<=\w)_(?!\w)")


def escaped(line: str) -> str:
    """The line with markup escaped outside of ``literals``."""
    parts = _LITERAL.split(line)
    parts[::2] = [_MARKUP.sub(lambda found: "\\" + found.group(), part) for part in parts[::2]]
    return "".join(parts)


def indentation(line: str) -> int:
    """Spaces before the text."""
    return len(line) - len(line.lstrip())


def plain(lines: list[str]) -> list[str]:
    """Text to reStructuredText: markup is escaped; literals may span lines; an indented block is kept as it is."""
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
    lines[:] = plain(lines)


def skip(app: Sphinx, what: str, name: str, found: Any, skipped: bool, options: Any) -> bool | None:
    """Fields of named tuples have no text of their own: the class describes them."""
    return True if (getattr(found, "__doc__", None) or "").startswith("Alias for field number") else None


def setup(app: Sphinx) -> dict[str, bool]:
    # Before napoleon, which turns the sections of a docstring into reStructuredText.
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-skip-member", skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
