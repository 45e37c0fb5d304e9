"""Texts that no terminal obeys: names in them come from files and folders."""

from __future__ import annotations


def printable(text: str, *, lines: bool = False) -> str:
    """A text with escapes in place of what a terminal would obey.

    Args:
        lines: whether it may have several lines.
    """
    return "".join(
        sign
        if sign.isprintable() or (lines and sign == "\n")
        else sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        for sign in text
    )
