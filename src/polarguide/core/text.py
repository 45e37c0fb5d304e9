"""Texts from people and from files: numbers in them, and what a terminal would obey."""

from __future__ import annotations

import math


def decimal(text: str) -> float:
    """A number as ``float`` reads it, without underscores (``1_0`` is more often a slip for 1.0 than ten) and digits of
    other scripts.

    Raises:
        ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def number_or_nan(text: str) -> float:
    """A number as ``decimal`` reads it; NaN if it is malformed, which every comparison refuses."""
    try:
        return decimal(text)
    except ValueError:
        return math.nan


def decimals(text: str) -> tuple[float, ...]:
    """The numbers of a list such as 1.9,1,1.6; none if it is something else."""
    try:
        return tuple(decimal(part) for part in text.split(","))
    except ValueError:
        return ()


def printable(text: str, *, lines: bool = False) -> str:
    """Escape control characters in a text, such as names of files, before it is printed.

    Args:
        lines: whether it may have several lines.
    """
    return "".join(
        sign
        if sign.isprintable() or (lines and sign == "\n")
        else sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        for sign in text
    )
