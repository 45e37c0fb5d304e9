"""Numbers in texts that people write: tables, lists of options."""

from __future__ import annotations

import math


def decimal(text: str) -> float:
    """A number as ``float`` reads it, but for what only Python takes for one: ``1_0``, and digits of other scripts.

    ``1_0`` is a slip for 1.0 more often than ten.

    Raises:
        ValueError: it is none.
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
